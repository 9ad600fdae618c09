"""Condensed pieces against the whole network solved at once, on random networks of drifts."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from processing.condensed import Condensed, condense
from processing.frame_assembly import lay_out, solve_frames
from processing.geometry import accumulate, compose, relative, wrap_angle
from processing.pose_graph import Links, solve

# Two squares with a side in common, and a spur. Pass 6 is another one at the tag of pass 0, joined to it by its scan.
PASSES = np.array([[0, 0], [30, 2], [60, 0], [62, 30], [31, 28], [-2, 30], [0.4, -0.7], [90, 1]], float)
DRIFTS = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (1, 4), (7, 2)]
INSIDE = 12  # poses of a piece between its two passes
STIFF = np.diag([1.0, 0.5, 20.0]) * 1e4


def no_links() -> Links:
    return Links.of(np.empty((0, 2)), np.empty((0, 3)), np.empty((0, 3, 3)), robust=True)


@dataclass
class Network:
    truth: np.ndarray  # (M, 3): the passes first, then what lies between them
    pieces: list[tuple[np.ndarray, Links]]  # which poses (n,), and the links between them, numbered within the piece
    between: Links  # between passes

    def solve_whole(self) -> np.ndarray:
        """The passes (V, 3), of all poses and links at once."""
        links = self.between
        for numbers, piece in self.pieces:
            links = links + Links(numbers[piece.ends], piece.motions, piece.informations, piece.robust)
        return solve(self.truth, links).poses[: len(PASSES)]

    def condense(self) -> list[Condensed]:
        """Each piece solved by itself, in a frame of its own, and all but its two passes eliminated."""
        condensed = []
        for numbers, links in self.pieces:
            chain = links.motions[: len(numbers) - 1]
            solution = solve(accumulate(np.array([5.0, 5.0, 2.0]), chain), links)
            boundary = np.array([0, len(numbers) - 1])
            condensed.append(condense(solution.poses, links, solution.weights, boundary, numbers[boundary]))
        return condensed


def build_network(seed: int, noise: float) -> Network:
    rng = np.random.default_rng(seed)
    poses = [np.array([x, y, rng.uniform(-np.pi, np.pi)]) for x, y in PASSES]
    members = []
    for i, j in DRIFTS:
        share = np.linspace(0, 1, INSIDE + 2)[1:-1, None]
        way = PASSES[i] + share * (PASSES[j] - PASSES[i]) + rng.normal(0, 1, (INSIDE, 2))
        members.append(np.array([i, *range(len(poses), len(poses) + INSIDE), j]))
        poses += list(np.column_stack([way, rng.uniform(-np.pi, np.pi, INSIDE)]))
    truth = np.array(poses)

    def measure(numbers: np.ndarray, ends: np.ndarray, robust: bool) -> Links:
        true = relative(truth[numbers[ends[:, 0]]], truth[numbers[ends[:, 1]]])
        motions = true + rng.normal(0, [noise, noise, noise / 5], true.shape)
        return Links.of(ends, motions, np.broadcast_to(STIFF, (len(ends), 3, 3)), robust)

    pieces = []
    for numbers in members:
        count = len(numbers)
        chain = np.column_stack([np.arange(count - 1), np.arange(1, count)])
        across = np.array([rng.choice(count, 2, replace=False) for _ in range(8)])
        pieces.append((numbers, measure(numbers, np.vstack([chain, across]), False)))
    return Network(truth, pieces, measure(np.arange(len(PASSES)), np.array([[0, 6], [6, 0]]), True))


def first_of(count: int) -> np.ndarray:
    return np.arange(count) == 0


def gap(a: np.ndarray, b: np.ndarray) -> float:
    """The largest difference of poses (V, 3) as seen from the first of them."""
    difference = relative(a[0], a) - relative(b[0], b)
    difference[:, 2] = wrap_angle(difference[:, 2])
    return float(np.abs(difference).max())


@pytest.mark.parametrize("seed", range(3))
def test_pieces_give_what_the_whole_network_gives(seed: int) -> None:
    """The law of the module. What is left is curvature, which falls with the square of the noise."""
    left = []
    for noise in (1e-3, 1e-2):
        network = build_network(seed, noise)
        pieces, whole = network.condense(), network.solve_whole()
        guess, part, _ = lay_out(pieces, network.between, len(PASSES))
        assert np.all(part == 0)
        poses, weights = solve_frames(guess, pieces, network.between, first_of(len(PASSES)))
        left.append(gap(poses, whole))
        assert left[-1] < 0.02 * gap(guess, whole)  # than the layout leaves open
        assert np.all(weights > 0.5)
    assert left[0] < 2e-4
    assert left[0] < 0.1 * left[1]


def test_cost_of_a_condensed_piece_is_that_of_its_links() -> None:
    """|R error|² is what chi squared grows by when the ends of the piece are held elsewhere and the rest gives way."""
    network = build_network(5, 1e-2)
    numbers, links = network.pieces[2]
    piece = network.condense()[2]
    own = solve(accumulate(np.zeros(3), links.motions[: len(numbers) - 1]), links)
    there = own.poses.copy()
    there[-1] = compose(there[-1], np.array([2e-3, -3e-3, 2e-4]))
    held = np.zeros(len(there), bool)
    held[[0, -1]] = True
    bent = solve(there, links, held)
    error = relative(there[0], there[-1]) - relative(piece.local[0], piece.local[1])
    assert_allclose(np.sum((piece.root @ error) ** 2), bent.chi2 - own.chi2, rtol=0.02)
    assert bent.chi2 - own.chi2 > 0.1


@pytest.mark.parametrize("seed", [6, 9, 10, 11])
def test_a_poor_first_guess_converges_to_the_same(seed: int) -> None:
    """Full steps from there do not lead down: this is what the damping is for."""
    network = build_network(1, 1e-2)
    pieces, between = network.condense(), network.between
    trusted = Links(between.ends, between.motions, between.informations, np.zeros(2, bool))
    guess, _, _ = lay_out(pieces, trusted, len(PASSES))
    expected, _ = solve_frames(guess, pieces, trusted, first_of(len(PASSES)))
    scattered = guess + np.random.default_rng(seed).normal(0, [15.0, 15.0, 1.2], guess.shape)
    poses, _ = solve_frames(scattered, pieces, trusted, first_of(len(PASSES)))
    assert gap(poses, expected) < 1e-3


def test_what_only_links_join_is_laid_out_by_the_surest_of_them() -> None:
    """A tag alone, three metres unsure, says less than a match, whichever was found first."""
    root, at = np.eye(3), np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    pieces = [Condensed(np.array(variables), at, root) for variables in ([0, 1], [2, 3])]
    ends, motions = np.array([[0, 2], [1, 3]]), np.array([[3.0, -2.0, 0.5], [1.0, 0.0, 0.0]])
    for order in ([0, 1], [1, 0]):
        informations = np.array([np.eye(3) / 9, np.eye(3) * 1e4])[order]
        poses, part, _ = lay_out(pieces, Links.of(ends[order], motions[order], informations, robust=False), 4)
        assert np.all(part == 0)
        assert_allclose(poses[3], [11.0, 0.0, 0.0], atol=1e-12)


def test_the_answer_does_not_depend_on_the_frame() -> None:
    network = build_network(2, 1e-2)
    pieces = network.condense()
    guess, _, _ = lay_out(pieces, network.between, len(PASSES))
    here, _ = solve_frames(guess, pieces, network.between, first_of(len(PASSES)))
    moved = np.array([500.0, -80.0, 2.5])
    there, _ = solve_frames(compose(moved, guess), pieces, network.between, first_of(len(PASSES)))
    assert_allclose(there[0], compose(moved, guess[0]))
    assert gap(there, here) < 1e-5


def test_a_link_that_lies_is_doubted_and_named() -> None:
    network = build_network(3, 1e-3)
    true = relative(network.truth[3], network.truth[5])
    lie = Links.of(np.array([[3, 5]]), (true + np.array([2.0, -1.0, 0.3]))[None], STIFF[None], robust=True)
    pieces = network.condense()
    guess, _, _ = lay_out(pieces, network.between, len(PASSES))
    expected, _ = solve_frames(guess, pieces, network.between, first_of(len(PASSES)))
    poses, weights = solve_frames(guess, pieces, network.between + lie, first_of(len(PASSES)))
    assert gap(poses, expected) < 1e-3
    assert weights[-1] < 0.1
    assert np.all(weights[:-1] > 0.5)


@pytest.mark.parametrize("backwards", [False, True])
def test_unconnected_parts_are_laid_out_each_from_its_first_piece(backwards: bool) -> None:
    network = build_network(4, 0.0)
    apart = [piece for k, piece in enumerate(network.condense()) if DRIFTS[k] not in [(1, 2), (3, 4), (4, 5)]]
    link = network.between[np.array([1 if backwards else 0])]
    poses, part, frames = lay_out(apart, link, len(PASSES))
    assert part.tolist() == [0, 0, 1, 1, 0, 0, 0, 1]
    assert_allclose(frames[0], 0)
    for piece, frame in zip(apart, frames, strict=True):
        assert_allclose(relative(compose(frame, piece.local), poses[piece.variables]), 0, atol=1e-6)
    for number in (0, 1):
        members = np.flatnonzero(part == number)
        assert gap(poses[members], network.truth[members]) < 1e-6


def test_a_piece_of_one_pass_is_placed_and_pulls_at_nothing() -> None:
    network = build_network(6, 1e-3)
    numbers, links = network.pieces[0]
    solution = solve(accumulate(np.zeros(3), links.motions[: len(numbers) - 1]), links)
    spur = condense(solution.poses, links, solution.weights, np.array([0]), np.array([4]))
    assert spur.root.shape == (0, 0)
    pieces = network.condense()
    guess, _, frames = lay_out([*pieces, spur], network.between, len(PASSES))
    assert_allclose(compose(frames[-1], spur.local[0])[:2], guess[4, :2], atol=1e-9)
    with_spur, _ = solve_frames(guess, [*pieces, spur], network.between, first_of(len(PASSES)))
    without, _ = solve_frames(guess, pieces, network.between, first_of(len(PASSES)))
    assert gap(with_spur, without) < 1e-9


def test_nothing_to_solve_stays() -> None:
    spur = Condensed(np.array([0]), np.zeros((1, 3)), np.zeros((0, 0)))
    poses, part, frames = lay_out([spur], no_links(), 1)
    assert part.tolist() == [0]
    assert_allclose(frames[0], 0)
    solved, weights = solve_frames(poses, [spur], no_links(), first_of(1))
    assert_allclose(solved, 0)
    assert len(weights) == 0


def test_links_that_agree_close_a_loop_that_came_back_a_metre_off() -> None:
    """The drive was surer of itself than it should have been: one link it outweighs, a dozen that agree it does not."""
    corners = np.array([[0.0, 0, 0], [60, 0, np.pi / 2], [60, 60, np.pi], [0, 60, -np.pi / 2], [1.0, 0, 0]])
    sure = np.diag([20.0, 20.0, 500.0])  # 5 cm and 0.1° a side
    pieces = [
        Condensed(np.array([k, k + 1]), np.array([np.zeros(3), relative(corners[k], corners[k + 1])]), sure)
        for k in range(4)
    ]
    information = np.diag([50.0, 50.0, 500.0]) ** 2
    for count, off in ((12, 0.1), (1, 1.1)):
        links = Links.of(np.tile([0, 4], (count, 1)), np.zeros((count, 3)), np.tile(information, (count, 1, 1)), True)
        poses, weights = solve_frames(corners, pieces, links, first_of(5))
        assert np.hypot(*poses[4, :2]) < off
        assert np.all(weights > 0.9) == (count == 12)


def test_a_pass_that_ends_two_paths_of_one_piece_holds_them_together() -> None:
    """A run turns at a tag: in the piece, poses 1 and 2 are the same pass, which the piece alone has 0.2 m apart."""
    local = np.array([[0, 0, 0], [10.1, 0, 0], [9.9, 0.1, 0], [0, 1, 0.1]])
    piece = Condensed(np.array([0, 1, 1, 2]), local, 10.0 * (np.eye(9) + 0.5 * np.eye(9, k=3)))
    start = local[[0, 1, 3]]
    poses, _ = solve_frames(start, [piece], no_links(), first_of(3), max_iterations=3)  # Newton needs no more

    def errors(free: np.ndarray) -> np.ndarray:
        return piece.root @ (free.reshape(2, 3)[[0, 0, 1]] - local[1:]).ravel()

    assert_allclose(poses[1:], least_squares(errors, start[1:].ravel(), xtol=1e-12).x.reshape(2, 3), atol=1e-6)
