# `make demo` and `make test` do all set-up themselves, in .venv.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test test-rest test-all test-peers lint docs install sanitize torture findings

install: $(VENV)/.installed

NATIVE := torchrl_sparse/blocks/engine/native
PERIOD := torchrl_sparse/envs/period/period.cpp
HEADERS := $(wildcard $(NATIVE)/*.h)

# pip cannot override robosuite's pin of mink, which Python 3.13 needs (see pyproject.toml): there uv installs.
define editable
	if $(BIN)/python -c 'import sys; sys.exit(sys.version_info < (3, 13))'; then \
		$(BIN)/python -m pip install --quiet uv && $(BIN)/uv pip install --quiet --python $(BIN)/python --editable "$(1)"; \
	else $(BIN)/python -m pip install --quiet --no-compile --editable "$(1)"; fi
endef

# Of what is installed the tests import a quarter: Python compiles that when it first does, if it may write.
unexport PYTHONDONTWRITEBYTECODE
$(VENV)/.installed: pyproject.toml setup.py $(NATIVE)/native.cpp $(HEADERS) $(PERIOD)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(call editable,.[dev])
	touch $@

demo: install
	$(BIN)/python recipes/benchmark.py task=lift episodes=10 latency_repeats=10 out=outputs/demo \
		methods=[dense_noise,ddpm5_logsnr,ddpm5_logsnr:int8,bac,sag] videos=[dense,ddpm5_logsnr,bac]

PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile

# The quick tier: a few minutes on two cores.
test: install
	$(PYTEST) -m "not full and not slow"

# What the quick tier leaves out, but for gigabytes; with workers on Ray.
test-rest: $(VENV)/.ray
	$(PYTEST) -m "full and not slow"

test-all: test test-rest

# Against other people's packages: LeRobot in an environment of its own, since it needs Python 3.12 and numpy 2.
PEER_PYTHON ?= python3.12
LEROBOT := .venv-lerobot
$(LEROBOT)/.installed: tests/peers/lerobot/requirements.txt
	$(PEER_PYTHON) -m venv $(LEROBOT)
	$(LEROBOT)/bin/python -m pip install --quiet --upgrade pip
	$(LEROBOT)/bin/python -m pip install --quiet --requirement $<
	touch $@

test-peers: install $(LEROBOT)/.installed
	$(BIN)/python -m pip install --quiet openpi-client==0.1.2
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 0 tests/peers

$(VENV)/.ray: $(VENV)/.installed
	$(call editable,.[ray])
	touch $@

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	$(BIN)/lint-imports
	$(BIN)/mypy

# Tables that sort and filter, from npm: a site that needs no network to be read.
VENDOR := .ci/site/vendor
$(VENDOR): Makefile
	rm -rf $@ $@.part && mkdir -p $@.part
	cd $@.part && npm pack --silent datatables.net@3.1.5 datatables.net-dt@3.1.2
	tar xzf $@.part/datatables.net-3.1.5.tgz -C $@.part --strip-components=2 package/js/dataTables.min.js
	tar xzf $@.part/datatables.net-dt-3.1.2.tgz -C $@.part --strip-components=2 package/css/dataTables.dataTables.min.css
	rm $@.part/*.tgz && mv $@.part $@

# The pages and the API reference, in site/. The variables silence the theme's and a plugin's announcements.
docs: install $(VENDOR)
	NO_MKDOCS_2_WARNING=1 DISABLE_MKDOCS_2_WARNING=true $(BIN)/mkdocs build --strict --quiet

# The native engine under AddressSanitizer and UndefinedBehaviorSanitizer: any error ends the tests. Linux with g++.
SANITIZE := -fsanitize=address,undefined -fno-sanitize-recover=undefined
build/sanitize/native.so: $(NATIVE)/native.cpp $(HEADERS)
	mkdir -p $(@D)
	g++ -std=c++17 -O1 -g -fno-omit-frame-pointer $(SANITIZE) -ffp-contract=fast -pthread -shared -fPIC -o $@ $<

sanitize: install build/sanitize/native.so
	LD_PRELOAD="$$(g++ -print-file-name=libasan.so) $$(g++ -print-file-name=libubsan.so)" ASAN_OPTIONS=detect_leaks=0 \
		SANITIZED_NATIVE=$(CURDIR)/build/sanitize/native.so \
		$(BIN)/python -m pytest tests/blocks/engine/native tests/policies/diffusion/test_export*.py -k "not library"

# Half an hour of faults, see tests/torture/README.md; MINUTES=5 for less. Linux with g++.
MINUTES ?= 30
torture: install build/sanitize/native.so
	$(BIN)/python -m tests.torture minutes=$(MINUTES)

# Behaviours of public packages, each tried without this project, see findings/README.md. Installs what each one pins.
findings:
	@changed=; for finding in findings/*.sh; do \
		if PYTHON=$(PYTHON) bash $$finding > /dev/null 2>&1; then echo "as described  $$finding"; \
		else echo "CHANGED       $$finding"; changed="$$changed $$finding"; fi; done; \
	if [ -n "$$changed" ]; then echo "behaviour changed, or could not be run:$$changed"; exit 1; fi
