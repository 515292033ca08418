# make book   build the book: environment, data, every chapter, HTML      make doctor  what is missing on this machine
# make test   run everything that guards it                               make lab     open the notebooks
# make data   record the demonstrations                                   make lock    pin the dependencies anew
# make new-chapter NAME=12_force     a chapter from the template            make check-site  every page in a browser
# make zip    notebooks, results and library in one file                    make pdf       the rendered book as a PDF
# make test-full-size, make test-gpu   the profile gpu with random weights, on the CPU or on a card
# make test-network   a federation in bad weather, each node on a host of its own (Linux, as root)
# make check-zip   every chapter as a reader of the zip runs it (make book FROM_ZIP=1 does it too)
# make sbom, make audit   the locked packages as a bill of materials; known advisories about them (needs the network)
# make address URL=https://github.com/OWNER/REPOSITORY   the repository's address wherever it belongs (PAGES_URL=...)
# make clean  remove the built book and the test reports (environment, recordings and run folders stay)
#
# Everything is installed in this folder: uv in .uv, the environment in .venv, recordings and downloads in .cache.
# Settings from the environment: FEDVLA_PROFILE=tiny|laptop|gpu (default laptop), TORCH_BACKEND=cpu|cu128|... (the
# torch wheels uv takes; default: the locked ones), PYTHON=python3.11 (what bootstraps uv), TEST_WORKERS (processes that
# share the test files, then the chapters; every one computes on one thread and takes 2 GB), BOOK_JOBS (chapters that
# `make book` executes at a time) and FEDVLA_JOBS (what else is done at a time); default of both: one per core.
# TEST_WORKERS is one more than cores, since Flower's tests wait for each other, unless memory is short.
.DEFAULT_GOAL := help
.PHONY: help env address audit book sbom check-site check-zip data doctor test test-full-size test-gpu test-network lint lab lock new-chapter zip pdf clean
.DELETE_ON_ERROR:

PYTHON ?= python3
TEST_WORKERS ?= $(shell $(PYTHON) -c 'import os; gb = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30; print(max(1, min(os.cpu_count() + 1, int(gb / 3))))')
BIN := .venv/bin
UV := .uv/bin/uv
LOCK := requirements.lock
TORCH_BACKEND ?= $(shell cat .venv/.torch-backend 2>/dev/null)
STAMP := .venv/.installed$(if $(TORCH_BACKEND),-$(TORCH_BACKEND))
TORCH := ^(torch|torchvision|triton|nvidia-[^=]*|cuda-[^=]*)==

export FEDVLA_PROFILE ?= laptop
export FEDVLA_CACHE ?= $(CURDIR)/.cache/fedvla
export UV_PYTHON_INSTALL_DIR := $(CURDIR)/.uv/python
# Full size loads smolvla_base from the hub; below that a chapter that reaches for the network is a mistake.
export HF_HUB_OFFLINE ?= $(if $(filter gpu,$(FEDVLA_PROFILE)),0,1)
export HF_HOME ?= $(CURDIR)/.cache/huggingface
export HF_HUB_DISABLE_TELEMETRY := 1
export FLWR_HOME ?= $(CURDIR)/.cache/flwr
export FLWR_TELEMETRY_ENABLED := 0
export FLWR_DISABLE_UPDATE_CHECK := 1
export FLWR_DISABLE_RUNTIME_DEPENDENCY_INSTALLATION := 1
export RAY_USAGE_STATS_ENABLED := 0
export TOKENIZERS_PARALLELISM := false
export PYTHONHASHSEED := 0
export PYTHONDONTWRITEBYTECODE :=
export IPYTHONDIR := $(CURDIR)/.cache/ipython
export JUPYTER_CONFIG_DIR := $(CURDIR)/.cache/jupyter/config
export JUPYTER_DATA_DIR := $(CURDIR)/.cache/jupyter/data
export JUPYTER_RUNTIME_DIR := $(CURDIR)/.cache/jupyter/runtime
export JUPYTER_PREFER_ENV_PATH := 1
export MPLCONFIGDIR := $(CURDIR)/.cache/matplotlib
ifeq ($(shell uname -s),Linux)
export MUJOCO_GL ?= egl
endif

help:
	@sed -n '/^#/!q; s/^# \{0,1\}//p' Makefile

env: $(STAMP)

$(UV): requirements-uv.lock
	@$(PYTHON) -m venv --clear .uv || { echo "no virtual environment: apt-get install python3-venv, or PYTHON=<another Python from 3.9 up> make ..." >&2; exit 1; }
	.uv/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes --only-binary :all: -r requirements-uv.lock
	@touch $@

# The lock goes in as it stands, hashes checked. With TORCH_BACKEND a new environment gets torch first, from the wheels uv
# chooses for that backend; they are other files with other hashes, so the rest of the lock follows without torch and its
# CUDA libraries. The choice is remembered until .venv is removed.
$(STAMP): $(LOCK) pyproject.toml $(wildcard plugins/*/*.py plugins/*/pyproject.toml) $(UV)
	@$(if $(TORCH_BACKEND),rm -rf .venv,rm -f .venv/.installed*)
	@test -x $(BIN)/python || $(UV) venv --quiet --python 3.12 .venv || $(UV) venv --python '>=3.12,<3.14' .venv
ifeq ($(TORCH_BACKEND),)
	$(UV) pip sync --quiet --require-hashes --python $(BIN)/python $(LOCK)
else
	$(UV) pip install --python $(BIN)/python --torch-backend $(TORCH_BACKEND) \
	  $$(sed -nE 's/^((torch|torchvision)==[^ ;]+).*/\1/p' $(LOCK))
	awk '/^[a-z0-9]/ {keep = !/$(TORCH)/} keep' $(LOCK) > .venv/without-torch.lock
	$(UV) pip install --quiet --no-deps --require-hashes --python $(BIN)/python -r .venv/without-torch.lock
	@echo $(TORCH_BACKEND) > .venv/.torch-backend
endif
	$(UV) pip install --quiet --no-deps --no-build-isolation --python $(BIN)/python --editable . \
	  $(patsubst %,--editable ./%,$(wildcard plugins/*))
	@touch $@

doctor: $(STAMP)
	$(BIN)/fedvla doctor

data: $(STAMP)
	$(BIN)/fedvla record

# Records the demonstrations first, unless no chapter has to be executed. FROM_ZIP=1: the chapters as readers of the zip run them.
book: doctor
	$(BIN)/python book/tools/build_book.py --profile $(FEDVLA_PROFILE) $(if $(BOOK_JOBS),--jobs $(BOOK_JOBS)) $(if $(FROM_ZIP),--from-zip)

# Every page of the rendered book, in the system's Chromium.
check-site: $(STAMP)
	$(BIN)/python book/tools/check_site.py _build/html/$(FEDVLA_PROFILE)

# What is attached to a release.
zip: $(STAMP)
	$(BIN)/python book/tools/make_zip.py

# Every chapter from that zip, at the profile tiny: an empty folder, and the wheel in place of the source.
check-zip: $(STAMP)
	$(BIN)/python book/tools/check_zip.py -n $(TEST_WORKERS) --dist loadfile

# The locked packages as a bill of materials (CycloneDX), for whoever has to know what is installed.
sbom: $(UV)
	@mkdir -p _build
	$(UV) tool run --quiet --from cyclonedx-bom==7.5.0 cyclonedx-py requirements $(LOCK) --output-reproducible --of JSON -o _build/sbom.json

# Needs the network: are there known advisories about what is locked?
audit: $(UV)
	$(UV) tool run --quiet pip-audit==2.10.1 --require-hashes --disable-pip -r $(LOCK)

# Needs the executed chapters of `make book`, and the system's Chromium.
pdf: $(STAMP)
	$(BIN)/python book/tools/make_pdf.py --profile $(FEDVLA_PROFILE)

new-chapter: $(STAMP)
	@$(BIN)/python book/tools/new_chapter.py "$(NAME)"

# With it, the book gets its buttons and whole addresses. PAGES_URL: where the book is, if not where GitHub puts it.
address: $(STAMP)
	@$(BIN)/python book/tools/set_address.py "$(URL)" $(if $(PAGES_URL),--pages "$(PAGES_URL)")

lab: $(STAMP)
	cd notebooks && ../$(BIN)/jupyter lab

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/codespell README.md CONTRIBUTING.md CHANGELOG.md book/*.md notebooks/*.ipynb

# Coverage counts the tests alone. Two chapters then run with nbmake, as a reader of the zip may run them: unpacked, with the
# library from the wheel. `make book FROM_ZIP=1` runs all of them so, with papermill, and shows what came out; .ci/run does both.
test: export FEDVLA_PROFILE := tiny
test: export HF_HUB_OFFLINE := 1
test: export COVERAGE_CORE := sysmon
test: doctor lint
	$(BIN)/pytest -n $(TEST_WORKERS) --dist loadfile --no-loadscope-reorder --durations 20 --cov --cov-report term \
	  --cov-report xml:_build/tests/coverage.xml --junitxml _build/tests/junit.xml
	$(BIN)/python book/tools/check_zip.py --only 10_ 90_ -n $(TEST_WORKERS) --dist loadfile --junitxml "$(CURDIR)/_build/tests/junit-notebooks.xml"

# The profile `gpu` with random weights: on the CPU, which takes 9 GB and up to half an hour, or on a card.
test-full-size: $(STAMP)
	$(BIN)/pytest -m full_size -s

test-gpu: $(STAMP)
	$(BIN)/pytest -m gpu -s

test-network: $(STAMP)
	$(BIN)/pytest -m network -s -rs

lock: $(UV)
	$(UV) pip compile --quiet --universal --python-version 3.12 --all-extras --generate-hashes --no-annotate \
	  --custom-compile-command "make lock" $(if $(UPGRADE),--upgrade) pyproject.toml -o $(LOCK)
	echo 'uv==$(shell $(UV) --version | cut -d" " -f2)' | $(UV) pip compile --quiet --universal --python-version 3.12 \
	  --generate-hashes --no-annotate --custom-compile-command "make lock" - -o requirements-uv.lock

clean:
	rm -rf _build .pytest_cache .ruff_cache .coverage
