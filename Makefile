# Usage: make figures KITTI=/path CITYSCAPES=/path PROFILE=smoke|lab|demo|thesis. make help lists all commands.
SHELL := /bin/bash
.SHELLFLAGS := -o pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

PYTHON ?= python3
BIN := .venv/bin
# Refuse a wrong or missing Python, and another one than that of .venv.
version = $(shell $(1) -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)
INSTALLED := $(if $(wildcard .venv/ready),$(call version,$(BIN)/python))
PLACE := $(shell cat .venv/ready 2>/dev/null)
ifneq (,$(filter-out help clean,$(MAKECMDGOALS)))
# The programs of a copied .venv run the original's package; those of a moved one do not run.
ifneq ($(realpath .venv),$(or $(PLACE),$(realpath .venv)))
$(error .venv was installed in $(PLACE) and works only there: delete it (rm -r .venv), and make installs it here)
endif
ifneq (,$(if $(INSTALLED),$(filter command line,$(origin PYTHON)),no .venv))
GIVEN_VERSION := $(call version,$(PYTHON))
ifeq (,$(filter 3.11 3.12 3.13,$(GIVEN_VERSION)))
$(error $(PYTHON) is $(or $(GIVEN_VERSION),no Python): Python 3.11, 3.12 or 3.13 is needed; name one with PYTHON=/path)
endif
ifeq (,$(filter $(or $(INSTALLED),$(GIVEN_VERSION)),$(GIVEN_VERSION)))
$(error $(PYTHON) is $(GIVEN_VERSION), but .venv has Python $(INSTALLED): run make clean first, or leave PYTHON out)
endif
endif
endif

# Other programs' settings in the environment may have these names. THESIS_REPRO_BUILD and THESIS_REPRO_FIGURES are taken.
$(foreach name,BUILD FIGURES GPU,$(if $(filter environment,$(origin $(name))),$(eval $(name) :=)))

# Refuse a misspelled setting, for which the default would silently be used.
SIZES := IMAGE_SIZE BASE_FILTERS BATCH_SIZE EPOCHS FRAMES WIDTHS REPETITIONS
KNOWN := KITTI LABELS CITYSCAPES CAMVID KITTI_SEMANTIC PSEUDO PROFILE BUILD FIGURES JOBS DASK_SCHEDULER PYTHON GPU $(SIZES)
GIVEN := $(foreach name,$(.VARIABLES),$(if $(filter command line,$(origin $(name))),$(name)))
UNKNOWN := $(filter-out $(KNOWN) MAKEFLAGS MAKEOVERRIDES -*-%,$(GIVEN))
ifneq (,$(UNKNOWN))
$(error $(firstword $(UNKNOWN)): unknown setting; known are $(KNOWN))
endif
# Refuse an empty setting, such as an unset shell variable, and settings that make evidence ignores.
EMPTY := $(strip $(foreach name,$(filter $(KNOWN),$(GIVEN)),$(if $(strip $($(name))),,$(name))))
ifneq (,$(EMPTY))
$(error $(firstword $(EMPTY))= is empty; give it a value, or leave it out)
endif
ifneq (,$(filter evidence,$(MAKECMDGOALS)))
UNUSED := $(filter-out KITTI LABELS FRAMES REPETITIONS JOBS PYTHON,$(filter $(KNOWN),$(GIVEN)))
ifneq (,$(UNUSED))
$(error $(firstword $(UNUSED)): make evidence takes only KITTI, LABELS, FRAMES, REPETITIONS and JOBS)
endif
endif
# Take settings from the package's THESIS_REPRO_ variables, too.
$(foreach name,KITTI CITYSCAPES KITTI_SEMANTIC PROFILE BUILD FIGURES JOBS DASK_SCHEDULER $(SIZES),\
  $(if $($(name)),,$(if $(THESIS_REPRO_$(name)),$(eval $(name) := $$(THESIS_REPRO_$(name))))))
PROFILE ?= $(if $(filter lab,$(MAKECMDGOALS)),lab,demo)
ifneq (1 1,$(words x$(BUILD)) $(words x$(FIGURES)))
$(error BUILD and FIGURES: make allows no space in a file name; name another folder)
endif
ifneq (,$(filter-out 0 1,$(GPU)))
$(error GPU=$(GPU): must be 1 or 0)
endif

# Make relative paths absolute, because notebooks run in their own folder. Paths may contain spaces.
absolute = $(if $(filter /% ~%,$(firstword $(1))),$(1),$(CURDIR)/$(1))

export THESIS_REPRO_PROFILE := $(PROFILE)
$(foreach name,KITTI CITYSCAPES KITTI_SEMANTIC BUILD FIGURES,$(if $($(name)),\
  $(eval export THESIS_REPRO_$(name) = $$(call absolute,$$($(name))))))
$(foreach name,JOBS DASK_SCHEDULER $(SIZES),$(if $($(name)),$(eval export THESIS_REPRO_$(name) := $($(name)))))
# The shell reads these paths from the environment, so they may contain quotes.
DATA_OPTIONS := $(if $(KITTI),--kitti "$$THESIS_REPRO_KITTI") \
                $(if $(CITYSCAPES),--cityscapes "$$THESIS_REPRO_CITYSCAPES") \
                $(if $(KITTI_SEMANTIC),--kitti-semantic "$$THESIS_REPRO_KITTI_SEMANTIC")
# Everything runs the package of this checkout. Folders of the user's in PYTHONPATH could hold other versions of it and
# of the libraries.
export PYTHONPATH := $(CURDIR)
# Silence the libraries.
export PYTHONWARNINGS := ignore
export PYDEVD_DISABLE_FILE_VALIDATION := 1
# Without bytecode files, each start of TensorFlow takes 20 s instead of 5 s (pip runs with --no-compile).
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup figures evidence trainings test torture lint lab bench weights clean check-data

help:
	@echo "make figures     write every table and figure to figures/, from embedded data"
	@echo "                 KITTI=/path CITYSCAPES=/path   from your own data"
	@echo "                 KITTI_SEMANTIC=/path           also test the label maps on KITTI's street scenes"
	@echo "                 PROFILE=smoke|lab|demo|thesis  size of the run (demo); single sizes: IMAGE_SIZE BASE_FILTERS"
	@echo "                 BATCH_SIZE EPOCHS FRAMES=N|all WIDTHS=5,10|1-15 REPETITIONS; number of processes: JOBS"
	@echo "make test        run the unit tests, and every notebook with PROFILE=smoke"
	@echo "make torture     run the tests of kills, faults and bad input (some minutes)"
	@echo "make lint        check format and style (Ruff) and types (mypy)"
	@echo "make lab         open copies of the notebooks in JupyterLab with PROFILE=lab (up to two minutes each)"
	@echo "make check-data  check the folders KITTI=/path CITYSCAPES=/path KITTI_SEMANTIC=/path"
	@echo "make evidence    make figures PROFILE=thesis from real frames, KITTI=/path, and keep what shows no frame in figures/kitti_excerpts;"
	@echo "                 LABELS='/path /path' compares further label maps"
	@echo "make trainings   after make figures: train nine more networks, and compare masks from all ten (half an hour)"
	@echo "make bench       measure the relative cost of odometry and network (KITTI=/path), into build/bench.json"
	@echo "make weights     train the shipped model anew into build/shipped, CAMVID=/path KITTI_SEMANTIC=/path PSEUDO=/path"
	@echo "make setup       only install the pinned packages into .venv; GPU=1 adds CUDA for an NVIDIA GPU"
	@echo "make clean       delete .venv, build and the figures of other data and profiles"

setup: .venv/ready $(if $(filter-out 0,$(GPU)),.venv/ready-gpu)

# uv takes a third of pip's time. It ignores pip's settings, so pip is used if uv cannot reach a package index. Exit
# status 130 is Ctrl-C.
install = $(BIN)/uv pip install --quiet --system-certs --python $(BIN)/python --no-deps $(1) 2>/dev/null || { \
            [ $$? != 130 ] && $(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-compile $(1); }

.venv/ready: environment.txt pyproject.toml
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { \
	  echo "$(PYTHON) has no venv module: install it (Debian and Ubuntu: apt-get install python3-venv)" >&2; exit 1; }
	@echo "installing the pinned packages into .venv (2.4 GB)"
	@$(PYTHON) -m venv .venv
	@$(BIN)/pip install --quiet --disable-pip-version-check $$(grep -o '^uv==[0-9.]*' environment.txt) 2>/dev/null || true
	@$(call install,-r environment.txt)
	@$(call install,--no-build-isolation -e .)
	@(cd .venv && pwd -P) > $@

.venv/ready-gpu: environment-gpu.txt .venv/ready
	@echo "installing CUDA for an NVIDIA GPU into .venv (about 2.5 GB to download)"
	@$(call install,-r environment-gpu.txt)
	@$(BIN)/python -c 'import tensorflow as tf; print("GPUs that TensorFlow sees:", len(tf.config.list_physical_devices("GPU")))'
	@touch $@

# settings.py names the folder of the run, which depends on the settings. It needs no installed package.
NOTEBOOKS := $(sort $(wildcard notebooks/*.ipynb))
ifneq (,$(filter figures,$(MAKECMDGOALS)))
# $(shell) does not see exported variables in older versions of make, so they are passed on.
RUN := $(shell $(foreach name,PROFILE KITTI CITYSCAPES KITTI_SEMANTIC BUILD FIGURES JOBS DASK_SCHEDULER $(SIZES),THESIS_REPRO_$(name)='$(subst ','\'',$(THESIS_REPRO_$(name)))') \
         $(if $(INSTALLED),$(BIN)/python,$(PYTHON)) -m thesis_repro.running.settings)
ifeq (,$(RUN))
$(error the settings above are wrong)
endif
# With real frames and no Cityscapes, the shipped model makes the label maps, so nothing is rendered or trained.
ifneq (,$(THESIS_REPRO_KITTI))
ifeq (,$(THESIS_REPRO_CITYSCAPES))
NOTEBOOKS := $(filter-out notebooks/01_% notebooks/02_% notebooks/04_%,$(NOTEBOOKS))
endif
endif
EXECUTED := $(patsubst notebooks/%,$(RUN)/notebooks/%,$(NOTEBOOKS))
# A change of the page does not rerun the notebooks.
SOURCES := $(shell find thesis_repro street_world notebooks/thesis -type f -not -path '*/__pycache__/*' -not -path '*/page.*' -not -name '*.html.j2' \
             -not -name 'page.css' -not -name 'captions.json')

figures: $(EXECUTED)
	@PYTHONPATH=$(CURDIR):$(CURDIR)/notebooks $(BIN)/python -m thesis.page
	@$(BIN)/python -m thesis_repro.running.settings figures
	@for notebook in $(EXECUTED); do [ -e $$notebook ] || exit 1; done

# This file is rewritten only if a byte of the data has changed. Then the notebooks run again.
$(RUN)/checked: .venv/ready FORCE
	@mkdir -p $(@D)
	@$(if $(strip $(DATA_OPTIONS)),$(BIN)/python -m thesis_repro.checks $@,[ -e $@ ] || touch $@)

FORCE:

# Which notebooks each notebook needs, because it reads their files; one that is not listed needs the one before it.
# Two notebooks run at once if neither needs the other: most use only one core at times, and training always does.
NEEDS_01 :=
NEEDS_02 := 01
NEEDS_03 :=
NEEDS_04 := 01 02 03
NEEDS_05 := 01 04
NEEDS_06 := 05
NEEDS_07 := 05 06
NEEDS_08 := 05 06
NEEDS_09 := 01 04 05 08
ifneq (1,$(JOBS))
MAKEFLAGS += -j2
endif
needed = $(foreach number,$(NEEDS_$(1)),$(filter $(RUN)/notebooks/$(number)_%,$(EXECUTED)))

# If a notebook fails, those that need it are skipped. The page is written and says what is missing, and make ends with
# an error. If a notebook is interrupted (exit status other than 1), make stops.
define execute
$(RUN)/notebooks/$(1): notebooks/$(1) $(2) $(RUN)/checked $(SOURCES)
	@mkdir -p $$(@D)
	@for needed in $(2); do [ -e $$$$needed ] || { rm -f $$@; exit 0; }; done; \
	$(BIN)/python -m thesis_repro.report.execute $$< $$@ || { \
	  status=$$$$?; rm -f $$@; [ $$$$status = 1 ] || exit $$$$status; }
endef
previous :=
$(foreach notebook,$(notdir $(NOTEBOOKS)),\
  $(eval number := $(firstword $(subst _, ,$(notebook))))\
  $(eval $(call execute,$(notebook),$(if $(filter undefined,$(origin NEEDS_$(number))),$(previous),$(call needed,$(number)))))\
  $(eval previous := $(RUN)/notebooks/$(notebook)))

# Notebook 8 does not wait for 7: it needs only the settings that 7 writes at its start, and reads them at its end.
$(filter $(RUN)/notebooks/08_%,$(EXECUTED)): notebooks/07_visual_odometry.ipynb

# Render the drives of the embedded world and compile the odometry while the network is trained. This only saves time:
# notebook 5 renders the same drives if they are missing, and reports errors.
ifeq (,$(THESIS_REPRO_KITTI))
$(filter $(RUN)/notebooks/05_%,$(EXECUTED)): $(RUN)/drives
$(RUN)/drives: $(filter $(RUN)/notebooks/01_%,$(EXECUTED)) $(RUN)/checked
	@nice $(BIN)/python -m street_world && \
	  nice $(BIN)/python -m thesis_repro odometry --kitti $(dir $(RUN))world-$(PROFILE)/kitti --sequence 00 --estimator refined >/dev/null || true
	@touch $@
endif
endif

check-data: setup
	@$(BIN)/python -m thesis_repro check-data $(DATA_OPTIONS)

# All tests of a file run in one process, because they share fixtures that take seconds.
test: setup
	@$(BIN)/python -m pytest -q -n $(shell nproc) --dist loadfile --no-loadscope-reorder

torture: setup
	@$(BIN)/python -m pytest -q -m torture

lint: setup
	@$(BIN)/ruff format --check --quiet . || { echo "run $(BIN)/ruff format ." >&2; exit 1; }
	@$(BIN)/ruff check .
	@$(BIN)/mypy

# Lessons edit copies, so that the notebooks in git stay as they are. An edited copy is kept.
LAB := $(if $(THESIS_REPRO_BUILD),$(THESIS_REPRO_BUILD),build)/lab
lab: setup
	@mkdir -p "$(LAB)" && for name in notebooks/*.ipynb notebooks/thesis; do \
	  [ -e "$(LAB)/$${name##*/}" ] || cp -r "$$name" "$(LAB)" || exit 1; done
	@echo "the notebooks are copies in $(LAB); delete one to get it anew"
	@$(BIN)/jupyter lab "$(LAB)" --LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate $(if $(filter 0,$(shell id -u)),--allow-root)

bench: setup
	@$(if $(KITTI),,$(BIN)/python -m thesis_repro synthesize build/world-demo)
	@$(BIN)/python tools/bench.py --kitti "$${THESIS_REPRO_KITTI:-build/world-demo/kitti}"

evidence: setup
	@$(if $(KITTI),,echo "KITTI must name the folder of the KITTI odometry benchmark (sequences, poses)" >&2; exit 1)
	@$(MAKE) figures PROFILE=thesis
	@THESIS_REPRO_PROFILE=thesis $(BIN)/python tools/evidence.py $(foreach folder,$(LABELS),"$(folder)")

# The network and the drives come from make figures.
trainings: setup
	@$(BIN)/python tools/trainings.py

weights: setup
	@$(foreach name,CAMVID KITTI_SEMANTIC PSEUDO,$(if $($(name)),,echo "$(name) must name a folder with train and trainannot" >&2; exit 1;))
	@$(BIN)/python tools/train_shipped.py "$(CAMVID)" "$(KITTI_SEMANTIC)" "$(PSEUDO)" build/shipped

clean:
	rm -rf .venv build *.egg-info .pytest_cache .ruff_cache .mypy_cache
	find figures -mindepth 1 -maxdepth 1 -type d -not -name kitti_excerpts -not -name timings -exec rm -rf {} +
	find . -name __pycache__ -prune -exec rm -rf {} +
