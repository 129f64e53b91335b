# Works on a machine that has only Python >= 3.11, make and git: every target makes its own .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DATA ?= ../shared/data
SECONDS_OF_SOAK ?= 900
SECONDS_OF_FUZZ ?= 3600
# One thread a process, as the command itself has it: more of them fight over the cores for matrices this small.
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
export MKL_NUM_THREADS := 1

.PHONY: demo test lint types contracts docs check proto lock bench benches faults fuzz fuzz-decoders fuzz-hub soak browser clean

demo: $(STAMP)
	$(BIN)/syncline demo --out demo-out

test: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)
	$(BIN)/mypy

contracts: $(STAMP)
	$(BIN)/lint-imports

# The documentation as a site in build/site; a broken link, anchor or equation is an error. NO_MKDOCS_2_WARNING: the
# theme's notice about a future version of MkDocs.
docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --site-dir build/site

check: test lint types contracts

# Speed and scale beside what a user would pick, one table: `make bench`, `make bench QUICK=1`, `make bench KEEP=1`.
# The peers (extra `bench`, opencv-contrib in a folder of its own) are fetched once; what cannot be had is left out.
bench: $(STAMP) $(VENV)/.peers
	$(BIN)/python -m tests.bench $(if $(QUICK),--quick) $(if $(KEEP),--keep) --data $(DATA)

$(VENV)/.peers: $(STAMP)
	-$(BIN)/python -m tests.bench.peers
	@touch $@

# How good the answers are: every bench of accuracy in turn.
benches: $(STAMP) $(VENV)/.peers
	$(BIN)/python -m tests.bench.every $(if $(QUICK),--quick) --data $(DATA)

# Faults of links, processes, clocks, cameras, disks; enemies with and without certificates: the matrix with its figures.
faults: $(STAMP)
	$(BIN)/python -m tests.faults -n 2 --dist loadfile

# The live view, the page of `quick` and the report in headless Chromium; without one the tests skip, loudly.
browser: $(STAMP)
	$(BIN)/python -m pytest tests/browser

# Damaged inputs for every decoder of what others send, for an hour of one core, and beside it hostile cameras against
# a whole hub; seeds by the time, printed in the output.
fuzz: $(STAMP)
	$(MAKE) --jobs 2 fuzz-decoders fuzz-hub

fuzz-decoders: $(STAMP)
	$(BIN)/python -m tests.faults.fuzz --seconds $(SECONDS_OF_FUZZ)

fuzz-hub: $(STAMP)
	$(BIN)/python -m pytest tests/property --hypothesis-profile=fuzz

# The demo's processes for 15 minutes: memory of each, and its growth after warm-up.
soak: $(STAMP)
	$(BIN)/python -m tests.faults.soak --seconds $(SECONDS_OF_SOAK)

# Regenerates the protobuf code; a test fails if it is not what the .proto says.
proto: $(STAMP)
	$(BIN)/python -m tests.generate_messages

# Renews the pinned versions in requirements.lock from pyproject.toml; it is complete, so that nothing else is installed.
lock: $(STAMP)
	$(BIN)/uv pip compile --quiet --universal --no-header --no-annotate --no-emit-index-url --no-emit-find-links \
	  --python-version 3.11 --extra dev --extra keys --extra uav --extra view --extra video --extra v4l2 --extra onnx --extra evaluation --extra c3d --extra keypoints --extra cluster pyproject.toml -o requirements.lock

$(STAMP): pyproject.toml requirements.lock hatch_build.py protocols/geometry/kernels.c
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Syncline needs Python 3.11 or newer: make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $(STAMP)

clean:
	rm -rf $(VENV) demo-out soak-out out
