# make run | suites | test | slow | stock | cluster | lint | docs | bench | policies | wheel | schemas | requirements | clean. Each sets up what it needs: Python's own venv in .venv, pinned packages from requirements.txt.

PYTHON := .venv/bin/python
READY := .venv/.ready
OUT ?= runs/$(shell date +%Y%m%d-%H%M%S)
WORKERS ?= 2
ARGS ?=
# One thread a process: the tests run in several, and simulation gains nothing from more.
ONE_THREAD := OMP_NUM_THREADS=1
# Neighbours stay together, so that what a file of tests shares (a run, a recording, pages) is made once, not once in every process.
SHARED := -n $(WORKERS) --dist worksteal

SHORT := open_drawer close_drawer press_button door pick_place lift
# What the specialists were weak at with as few demonstrations as the others.
HARD := push stack nut_assembly
EPISODES ?= 240
INSTANCES ?= 50
POLICIES := local_small remote_specialist remote_base remote_large

.PHONY: suites run test slow stock cluster lint docs bench policies wheel schemas requirements environment clean

run: $(READY)
	$(PYTHON) -m osel_sim.run --task pick_place --policies local_small remote_large --counterfactual --video 3 --out $(OUT) $(ARGS)

test: $(READY)
	$(ONE_THREAD) $(PYTHON) -m pytest -m "not slow" $(SHARED) $(ARGS)

slow: $(READY)
	$(ONE_THREAD) $(PYTHON) -m pytest -m slow $(SHARED) $(ARGS)

# What LeRobot's Diffusion and SmolVLA need besides lies in a folder of its own: where transformers is installed, every import of LeRobot takes twice as long.
STOCK := .venv/stock

stock: $(READY)
	[ requirements-stock.txt -ot $(STOCK)/.ready ] || { \
		.venv/bin/uv pip install --quiet --compile-bytecode --python $(PYTHON) --no-deps --target $(STOCK) -r requirements-stock.txt && touch $(STOCK)/.ready; }
	PYTHONPATH=$(STOCK) $(ONE_THREAD) $(PYTHON) -m pytest tests/test_stock_policies.py $(ARGS)

# Likewise submitit and Ray, all of whose other needs are pinned already.
CLUSTER := .venv/cluster

cluster: $(READY)
	[ requirements-cluster.txt -ot $(CLUSTER)/.ready ] || { \
		.venv/bin/uv pip install --quiet --python $(PYTHON) --no-deps --target $(CLUSTER) -r requirements-cluster.txt && touch $(CLUSTER)/.ready; }
	PYTHONPATH=$(CLUSTER) $(ONE_THREAD) $(PYTHON) -m pytest tests/test_cluster.py $(ARGS)

lint: $(READY)
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/lint-imports

# Every warning is an error: a link or an anchor that leads nowhere, a page that is not in the navigation.
docs: $(READY)
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --quiet --strict
	@echo "written to build/site; open build/site/index.html"

bench: $(READY)
	$(PYTHON) benchmarks/simulation.py $(ARGS)

# From nothing to the checkpoints in assets/policies and what they can do: demonstrations, training, measurement. Interrupted, it goes on where it was.
# To see all of it happen in a few minutes, in a clone of which you need nothing: make policies EPISODES=8 INSTANCES=1 ARGS="--steps 30"
policies: $(READY)
	$(PYTHON) -m osel_sim.collect --task $(SHORT) --episodes $(EPISODES) --level 0 1 2 --out data/suite --resume
	$(PYTHON) -m osel_sim.collect --task $(HARD) --episodes $$(( $(EPISODES) * 3 )) --level 0 1 2 --out data/suite --resume
	$(PYTHON) -m osel_sim.collect --task tidy --episodes $$(( $(EPISODES) / 2 )) --level 0 1 2 --out data/suite/tidy --resume
	$(PYTHON) -m osel_sim.collect --task sort --episodes $$(( $(EPISODES) / 4 )) --level 0 1 2 --out data/suite/sort --resume
	for policy in $(POLICIES); do \
		$(PYTHON) -m osel_sim.train --policy $$policy --data data/suite --out runs/train/$$policy --half --resume $(ARGS) && \
		mkdir -p assets/policies/$$policy && cp runs/train/$$policy/*.json runs/train/$$policy/*.safetensors assets/policies/$$policy/ || exit 1; \
	done
	$(PYTHON) -m osel_sim.record --task all --level 0 2 --policies $(POLICIES) --instances $(INSTANCES) --repeats 3 --repeat-every 5 --action-noise 0.05 --out runs/suite $$([ ! -f runs/suite/run.json ] || echo --resume)

wheel: $(READY)
	$(PYTHON) -m build --no-isolation

# What editors complete and check TOML files by; a test compares them with the models.
schemas: $(READY)
	$(PYTHON) -m osel_sim.cli.schemas

# Compiles the pinned packages again. What is pinned stays as it is where it still fits; ARGS=--upgrade takes the newest.
requirements: $(READY)
	.venv/bin/uv pip compile --group dev pyproject.toml --quiet --no-annotate --no-header --no-emit-index-url --universal --python-version 3.12 \
		--output-file requirements.txt $(ARGS)
	@mkdir -p build && grep -v -E '^(mujoco|robosuite)==' requirements.txt > build/constraints.txt
	for list in osel_sim/suites/pins/*.in; do \
		.venv/bin/uv pip compile $$list --constraint build/constraints.txt --override osel_sim/suites/pins/overrides.txt --quiet --no-annotate --no-header \
			--no-emit-index-url --universal --python-version 3.12 --output-file $${list%.in}.txt $(ARGS) || exit 1; \
	done

# The Python environments of suites of others, in the user's cache folder; tests of a suite are skipped where its environment is missing.
suites: $(READY)
	$(PYTHON) -m osel_sim.suites install metaworld gym lerobot

environment: $(READY)

# requirements.txt holds the whole closure, hence --no-deps: nothing is resolved a second time.
$(READY): requirements.txt pyproject.toml plugins/lerobot_env_osel_sim/pyproject.toml
	@python=; for candidate in python3.12 python3.13 python3; do \
		if $$candidate -c 'import sys, venv; sys.exit(not (3, 12) <= sys.version_info[:2] < (3, 14))' 2>/dev/null; then python=$$candidate; break; fi; \
	done; \
	if [ -z "$$python" ]; then echo "error: Python 3.12 or 3.13 with its venv module is needed (Debian, Ubuntu: apt-get install python3.12-venv)" >&2; exit 2; fi; \
	echo "setting up .venv with $$($$python --version)"; \
	[ -x $(PYTHON) ] || $$python -m venv .venv
	$(PYTHON) -m pip install --quiet --disable-pip-version-check "$$(grep '^uv==' requirements.txt)"
	.venv/bin/uv pip install --quiet --compile-bytecode --python $(PYTHON) --no-deps -r requirements.txt
	.venv/bin/uv pip install --quiet --python $(PYTHON) --no-deps --no-build-isolation -e . -e plugins/lerobot_env_osel_sim
	$(PYTHON) -m osel_sim.cli.prepare
	@touch $@

clean:
	rm -rf .venv build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
