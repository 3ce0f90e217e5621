# Everything runs in .venv, which the first target makes. PYTHON chooses the interpreter (3.11 or newer).
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo docs wheels test short-tests test-long test-rllib nightly lint bench crash fuzz clean

demo: $(VENV)/.ready  ## train an adversary against a gated Kalman filter, compare it with scripted attacks, write the page
	$(BIN)/python train.py

docs: $(VENV)/.docs  ## the documentation as a site, boards and replays with it: site/index.html, to open from the folder
	$(BIN)/python -m sphinx --builder html --fail-on-warning --keep-going --quiet --jobs 2 --doctree-dir build/doctrees docs site
	@echo 'site/index.html'

short-tests test-long: export OPENBLAS_NUM_THREADS = 1
short-tests test-long: export OMP_NUM_THREADS = 1

test: $(VENV)/.ready  ## lint, types, tests, side by side; a thread in each of two processes
	@$(MAKE) --no-print-directory --jobs 2 lint short-tests

short-tests: $(VENV)/.ready
	$(BIN)/python -m pytest -n 2 --dist worksteal

test-long: $(VENV)/.docs lint  ## and the tests that take a minute each, as before a release
	$(BIN)/python -m pytest -n 2 --dist worksteal --long

test-rllib: .venv-rllib/.ready  ## tests of the environments with the versions that RLlib pins, gymnasium 1.2.2 among them
	.venv-rllib/bin/python -m pytest -n 2 tests/test_faces.py tests/test_face_laws.py tests/test_face_peers.py tests/test_specs.py \
	  tests/test_render.py tests/test_teaching.py tests/test_highway.py

nightly: test-long fuzz crash  ## everything: the long tests and both campaigns, five hours or so

lint: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

wheels:  ## wheel and sdist in empty environments of each Python that is found, some minutes each; LIGHT=1 without torch
	sh benchmarks/pythons.sh

bench: $(VENV)/.ready  ## speed beside the peers, in one run; writes benchmarks/results/speed.*
	$(BIN)/python -m tailgate bench --out benchmarks/results

crash: $(VENV)/.ready  ## end the long commands at random moments, and see that the next run makes good: some hours
	$(BIN)/python benchmarks/crash_campaign.py --ways interrupt,group,twice,terminate --moments 40
	$(BIN)/python benchmarks/crash_campaign.py --ways kill --moments 100

fuzz: $(VENV)/.ready  ## 10 000 malformed inputs for each reader; `make fuzz FUZZ="--reader rows --inputs 500"` for less
	$(BIN)/python benchmarks/fuzz.py $(FUZZ)

# torch comes first and pinned: left to the others it would be the largest build that exists. --no-compile: Python compiles what is imported
$(VENV)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.12")'
	@echo 'Installing into $(VENV): one to five minutes, torch first'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[all,dev]'
	touch $@

.venv-rllib/.ready: pyproject.toml constraints-rllib.txt
	$(PYTHON) -m venv .venv-rllib
	.venv-rllib/bin/python -m pip install --quiet --constraint constraints-rllib.txt torch
	.venv-rllib/bin/python -m pip install --quiet --constraint constraints-rllib.txt '.[train,game,highway,viz,pandas]' 'ray[rllib]' \
	  pytest pytest-xdist hypothesis
	touch $@

$(VENV)/.docs: $(VENV)/.ready
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[docs]'
	touch $@

clean:
	rm -rf $(VENV) .venv-rllib build dist site docs/generated *.egg-info
