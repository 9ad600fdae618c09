# `make demo` and `make test` set themselves up on a bare machine.
PY := .venv/bin/python

.PHONY: demo test lint bench hil lock

demo: .venv/ready
	$(PY) tests/system/demo.py

test: .venv/ready
	$(PY) -m pytest

# Ratios against other programs and against targets, measured side by side.
bench: .venv/bench
	missed=0; for benchmark in tests/benchmarks/bench_*.py; do $(PY) $$benchmark || missed=1; done; exit $$missed

# The long tests at the wire: replays through the emulators with faults, fuzzing, a soak.
hil: .venv/bench
	$(PY) -m pytest tests/hil

lint: .venv/ready
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/lint-imports

# Debian leaves venv out of python3; root (a container, CI) can put it there, anyone else is told.
.venv/ready: pyproject.toml requirements.lock
	@python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "RTLog needs Python 3.11 or newer"; exit 1; }
	@python3 -c 'import ensurepip' 2>/dev/null || [ "$$(id -u)" != 0 ] || { apt-get -qq update && apt-get -qq install -y python3-venv; }
	@python3 -c 'import ensurepip' 2>/dev/null || { echo "python3 lacks venv: apt-get install python3-venv"; exit 1; }
	python3 -m venv .venv
	$(PY) -m pip install --quiet --require-hashes -r requirements.lock
	$(PY) -m pip install --quiet --no-deps -e .
	touch $@

.venv/bench: .venv/ready bench.lock
	$(PY) -m pip install --quiet --require-hashes -r bench.lock
	touch $@

# Resolve pyproject.toml anew for every Python from 3.11 on.
lock:
	uv pip compile --universal --python-version 3.11 --extra dev --generate-hashes -q pyproject.toml -o requirements.lock
	uv pip compile --universal --python-version 3.11 --extra bench -c requirements.lock --generate-hashes -q pyproject.toml -o bench.lock
