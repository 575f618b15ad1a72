# Works with GNU make from 3.81 on, which macOS has.
SHELL := /bin/bash
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory
BIN := .venv/bin
# A setting reaches Python as a THESIS_REPRO_ variable: all that stand on the command line, of which Python names a misspelled
# one, and these of the environment.
SETTINGS := KITTI CITYSCAPES KITTI_SEMANTIC PROFILE IMAGE_SIZE BASE_FILTERS BATCH_SIZE EPOCHS FRAMES WIDTHS REPETITIONS JOBS \
            BUILD FIGURES DASK_SCHEDULER
OF_MAKE := PYTHON GPU RAW LISTEN RUN
of = $(foreach name,$(2),$(if $(filter $(1),$(origin $(name))),$(name)))
given := $(filter-out $(OF_MAKE) MAKE% -%,$(sort $(call of,command line,$(.VARIABLES))))
around := $(foreach name,$(call of,environment,$(SETTINGS)),$(if $(THESIS_REPRO_$(name)),,$(name)))
$(foreach name,$(given) $(around),$(eval export THESIS_REPRO_$(name) := $$($(name))))
ifneq ($(around),)
$(info from the environment: $(foreach name,$(around),$(name)=$($(name))))
endif
# Everything runs this checkout and its environment, without the user's settings of Python, pip, Jupyter, TensorFlow.
export PYTHONPATH := $(CURDIR):$(CURDIR)/notebooks
export PYTHONWARNINGS := ignore
export JUPYTER_NO_CONFIG := 1
export JUPYTER_PREFER_ENV_PATH := 1
export PYDEVD_DISABLE_FILE_VALIDATION := 1
# OpenMP allows a list, 4,2, for nested levels; Numba and numexpr read one number
comma := ,
ifneq ($(findstring $(comma),$(OMP_NUM_THREADS)),)
export OMP_NUM_THREADS := $(firstword $(subst $(comma), ,$(OMP_NUM_THREADS)))
endif
unexport PYTHONHOME PYTHONDONTWRITEBYTECODE PYTHONSTARTUP JUPYTER_PATH CDPATH TF_USE_LEGACY_KERAS XLA_FLAGS TF_XLA_FLAGS MPLBACKEND

.PHONY: help setup figures notebooks test lint lab book check-data excerpts evidence timings torture bench clean
help:
	@echo "make figures     write every table and figure to figures/, from embedded data, or from KITTI=/path CITYSCAPES=/path"
	@echo "                 (KITTI_SEMANTIC=/path: also test the label maps); size: PROFILE=smoke|lab|demo|thesis, or single:"
	@echo "                 IMAGE_SIZE BASE_FILTERS BATCH_SIZE EPOCHS FRAMES=N|all WIDTHS=5,10|1-15 REPETITIONS; processes: JOBS"
	@echo "make lab         open copies of the notebooks in JupyterLab with PROFILE=lab (up to two minutes each);"
	@echo "                 in a container LISTEN=0.0.0.0"
	@echo "make check-data  check the folders KITTI=/path CITYSCAPES=/path KITTI_SEMANTIC=/path"
	@echo "make test, lint  run the tests, and every notebook with PROFILE=smoke; check style (Ruff), types (mypy), imports"
	@echo "make torture     run the tests of kills, faults, bad input, the book, and of the oldest and newest packages (some minutes)"
	@echo "make book        after make figures: write its book into build/; a warning is an error"
	@echo "make excerpts    cut the frames of the evidence from KITTI=/path RAW=/path, and check them, into build/excerpts"
	@echo "make evidence    make figures PROFILE=thesis from KITTI=build/excerpts, and keep what shows no frame; from other"
	@echo "                 frames, elsewhere (whole sequences take hours; FRAMES=00:0-129,04:0-37 takes parts of sequences)"
	@echo "make timings     after make figures, or make evidence KITTI=build/excerpts: measure the times of their figures anew"
	@echo "make bench       measure the relative cost of the odometry (KITTI=/path), into build/bench.json"
	@echo "make setup       install the pinned packages into .venv (GPU=1: and CUDA)"
	@echo "make clean       delete .venv and all results"

# uv takes a third of pip's time, but ignores pip's settings, so pip follows if uv reaches no index. The options in PIP
# undo settings of pip that would install elsewhere.
PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-user --target= --prefix="$(CURDIR)/.venv"
install = $(BIN)/uv pip install --quiet --system-certs --python $(BIN)/python --no-deps $(1) || \
          { echo "uv failed, so pip is used" && $(PIP) --no-deps --no-compile $(1); }
setup: .venv/ready $(if $(filter 1,$(GPU)),.venv/ready-gpu)
	@$(BIN)/thesis-repro --version >/dev/null && $(BIN)/python tools/environment.py --check || { \
	  echo "error: .venv no longer works: was it moved or copied, or Python upgraded? Run make clean, then make setup" >&2; exit 1; }
.venv/ready: environment.txt pyproject.toml
	@python=$$($(or $(PYTHON),$$(command -v python3 python3.13 python3.12 python3.11 | head -n 1)) tools/environment.py \
	  $(if $(PYTHON),,--search)) && echo "installing the pinned packages into .venv (2.4 GB)" && "$$python" -m venv .venv
	@$(PIP) $$(grep -o '^uv==[0-9.]*' environment.txt)
	@$(call install,-r environment.txt)
	@$(call install,--no-build-isolation -e .)
	@echo "$(CURDIR)/notebooks" >"$$(echo .venv/lib/python3*/site-packages)/notebooks.pth"  # found from any folder
	@mkdir -p .venv/share/jupyter/lab/settings && touch $@ && \
	echo '{"@jupyterlab/apputils-extension:notification": {"fetchNews": "false"}}' >.venv/share/jupyter/lab/settings/overrides.json
.venv/ready-gpu: environment-gpu.txt .venv/ready
	@$(call install,-r environment-gpu.txt) && touch $@

figures: setup
	@$(BIN)/python -m thesis.run
book: setup
	@$(BIN)/python -m thesis.book

# `thesis.run` deletes what is out of date, writes into needs.mk which notebook needs which, and calls this with the folder of
# the run. A notebook that exists is done, whatever its date; nbconvert writes under another name. Its kernel has nothing to do
# at its end.
ifdef RUN
include $(RUN)/needs.mk
$(RUN)/notebooks/%.ipynb:
	@trap 'kill $$!; exit 130' INT TERM HUP; \
	$(BIN)/python -m nbconvert --to notebook --execute --ExecutePreprocessor.kernel_name=python3 \
	  --ExecutePreprocessor.timeout=-1 --ExecutePreprocessor.shutdown_kernel=immediate \
	  --output-dir $(@D) --output .$* notebooks/$*.ipynb >$(@:.ipynb=.log) 2>&1 & wait $$! \
	&& mv $(@D)/.$*.ipynb $@ && echo "$*: done in $$SECONDS s" \
	|| { echo "$* failed: $$($(call reason,$(@:.ipynb=.log))) ($(@:.ipynb=.log))" >&2; exit 1; }
# The sequences of the embedded world are rendered, and the shared odometry compiled, while the network is trained.
$(RUN)/sequences:
	@nice $(BIN)/python tools/render_ahead.py && touch $@
# The last line of a log is the error, but not if the kernel died: then it is what the kernel said, or else memory ran out.
reason = tr -d '\033' <$(1) | sed 's/\[[0-9;]*m//g' | awk '/^F[0-9]|^Fatal Python error|what\(\):/ && !said {said = $$0} NF {last = $$0} \
  END {print last !~ /DeadKernelError/ ? last : said ? said : "its kernel was killed, most likely because memory ran out"}'
endif

check-data: setup
	@$(BIN)/python -m thesis_repro check-data $${THESIS_REPRO_KITTI:+--kitti "$$THESIS_REPRO_KITTI"} \
	  $${THESIS_REPRO_CITYSCAPES:+--cityscapes "$$THESIS_REPRO_CITYSCAPES"} $${THESIS_REPRO_KITTI_SEMANTIC:+--kitti-semantic "$$THESIS_REPRO_KITTI_SEMANTIC"}
test: setup
	@$(BIN)/python -m pytest -q -n auto
torture: setup
	@$(BIN)/python -m pytest -q -m torture
lint: setup
	@$(BIN)/ruff format --check --quiet . && $(BIN)/ruff check . && $(BIN)/mypy && $(BIN)/lint-imports --no-logo --no-cache
# Lessons edit copies, so that the notebooks in git stay as they are. An edited copy is kept. They link docs and figures.
lab: setup
	@lab=$$($(BIN)/python -m thesis.run_settings) && lab=$${lab%/*}/lab && mkdir -p "$$lab" && \
	for path in notebooks/0[1-9]_*.ipynb notebooks/thesis; do test -e "$$lab/$${path#*/}" || cp -r "$$path" "$$lab"; done && \
	ln -sfn "$(CURDIR)/docs" "$(CURDIR)/figures" "$$lab" && \
	echo "the notebooks are copies in $$lab; delete one to get it anew. One that was idle for an hour loses its memory:" && \
	echo "run its cells again. Open the address below:" && \
	THESIS_REPRO_PROFILE=$(or $(THESIS_REPRO_PROFILE),lab) PYTHONPATH="$(CURDIR)" $(BIN)/python -m jupyter lab "$$lab" --log-level=ERROR \
	  --MappingKernelManager.cull_idle_timeout=3600 --MappingKernelManager.cull_connected=True \
	  $(if $(LISTEN),--ip=$(LISTEN) --no-browser) $(if $(filter 0,$(shell id -u)),--allow-root)
bench: setup
	@$(if $(KITTI),,$(BIN)/python -m thesis_repro synthesize build/world-demo)
	@$(BIN)/python tools/bench.py "$${THESIS_REPRO_KITTI:-build/world-demo/kitti}"
excerpts: setup
	@$(BIN)/python tools/excerpts.py "$(KITTI)" "$(RAW)"
evidence: setup
	@THESIS_REPRO_PROFILE=thesis $(BIN)/python -m thesis.run
	@THESIS_REPRO_PROFILE=thesis $(BIN)/python tools/evidence.py
	@$(BIN)/python tools/write_texts.py
timings: setup
	@$(if $(KITTI),THESIS_REPRO_PROFILE=$(or $(THESIS_REPRO_PROFILE),thesis)) $(BIN)/python tools/timings.py
clean:
	rm -rf .venv build *.egg-info .pytest_cache .ruff_cache .mypy_cache
	find figures -mindepth 1 -maxdepth 1 -type d -not -name kitti_excerpts -not -name camvid -not -name timings -exec rm -rf {} +
	find . -name __pycache__ -prune -exec rm -rf {} +
