# make demo    set up, replay bags/demo through the node, judge its answers: build/demo/
# make test    set up, run the whole test suite
# make check   set up, lint, check types and import rules
# make docs    set up, write the pages of the Python interface: build/docs/index.html

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

# Recordings and reference results for the tests that can use them (data/, bench/); optional.
export CELLO3D_EVALUATION ?= $(realpath ../shared)
export ROS_PYTHON_CHECK_FIELDS := 1

.PHONY: demo test check docs format clean

demo: $(VENV)/.ready
	$(BIN)/cello3d demo --out build/demo

test: $(VENV)/.ready
	$(BIN)/python -m pytest

check: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(VENV)/.ready
	$(BIN)/python docs/api.py build/docs

format: $(VENV)/.ready
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) build

# The ROS that is sourced is used when there is one, ROS 2 wheels from PyPI otherwise.
$(VENV)/.ready: setup.py
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; v < (3, 11) and sys.exit( \
	  "cello3d_ros needs Python 3.11 or newer; $(PYTHON) is Python %d.%d: make PYTHON=python3.12" % v)'
	@echo "Setting up $(VENV): about a minute, 2 GB."
	@set -e; \
	(while sleep 5; do echo "  still setting up"; done) & trap "kill $$!" EXIT; \
	if $(PYTHON) -c "import rclpy" 2>/dev/null; then \
	  $(PYTHON) -m venv --system-site-packages $(VENV); extras="open3d,dev"; \
	else \
	  $(PYTHON) -m venv $(VENV); extras="ros,open3d,dev"; \
	fi; \
	$(BIN)/python -m pip install --disable-pip-version-check --editable ".[$$extras]"
	touch $@
