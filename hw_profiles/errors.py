"""What can go wrong for a user, as one tree. Each message is one line that says what and where.

RTLogError            the work failed (exit status 1)
└── BadInputError     the user's input or usage is at fault (exit status 2)
"""


class RTLogError(Exception):
    """The work could not be done: a device, a network, a disk."""


class BadInputError(RTLogError):
    """A file, a profile or an argument is wrong; nothing was written."""
