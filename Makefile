# make train   .venv, then the main job on the embedded default
# make test    .venv, then the default tests
# make slow    .venv, then the slow ones
# make check   lint, types and import rules
# make docs    the documentation, into site/
# make lock    pin the dependencies anew
# make install-training   .venv without the simulator: trains flow networks and predicts
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: install install-training train test slow check docs lock clean

install: $(VENV)/installed

train: $(VENV)/installed
	$(BIN)/python launch/train.py algo=artflownet

# Two processes, each with the tests of a file at a time, whose fixtures they share.
PYTEST = $(BIN)/python -m pytest -n 2 --dist loadfile

test: $(VENV)/installed
	$(PYTEST) -m "not slow"

# What waits for pictures or measures time has the machine to itself.
slow: $(VENV)/installed
	$(PYTEST) -m "slow and not alone"
	$(BIN)/python -m pytest -m "slow and alone"

check: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: extra-docs
	$(BIN)/mkdocs build --strict

# What an extra of pyproject.toml names, without the package's own dependencies, which the lock holds: make extra-ray ...
EXTRA = import sys; from importlib.metadata import requires; [print(line.split(";")[0]) for line in requires("fb3d_rl") \
  if line.endswith(f"extra == \"{sys.argv[1]}\"")]
extra-%: $(VENV)/installed
	grep -v "^opencv" requirements.lock > $(VENV)/constraints.txt
	$(BIN)/python -c '$(EXTRA)' $* > $(VENV)/extra-$*.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint $(VENV)/constraints.txt -r $(VENV)/extra-$*.txt

# What trains flow networks and predicts, without the simulator and the tests' packages.
NEEDED = from pip._vendor import tomli; [print(line) for line in tomli.load(open("pyproject.toml", "rb"))["project"]["dependencies"] \
  if not line.startswith(("sapien", "mani-skill"))]
install-training:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -c '$(NEEDED)' > $(VENV)/training.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint requirements.lock -r $(VENV)/training.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .

# mani-skill asks for opencv-python, whose window toolkit needs the system's libGL and glib; the headless build of the
# same version is the same module without it. Reinstalled, because the two share files, which go with the former.
OPENCV = $(shell sed -n 's/^opencv-python==//p' requirements.lock)

# The file's date says when the lock was last installed.
$(VENV)/installed: requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(0 if (3, 10) <= sys.version_info < (3, 13) else "Python 3.10, 3.11 or 3.12 is needed; name one with: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip uninstall --quiet --yes opencv-python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --force-reinstall opencv-python-headless==$(OPENCV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $@

# torch pulls in its CUDA packages itself where its build needs them, so the lock leaves them out: it serves every machine.
lock: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	echo "torch==2.13.0" | $(BIN)/uv pip compile --universal --python-version 3.10 --extra dev --no-annotate --no-header \
	  --constraint - pyproject.toml --quiet | grep -vE "^(nvidia-(c|n[vc])|cuda-|triton)" > requirements.lock.part
	mv requirements.lock.part requirements.lock

clean:
	rm -rf $(VENV) *.egg-info
