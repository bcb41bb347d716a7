# Newcomers need two commands, `make demo` and `make test`; both first make the environments they use.
SHELL := /bin/bash
SETUP := bash requirements/setup.sh

# One pytest run may take this many seconds: bpy 4.5 can hang when the interpreter ends. Needs GNU timeout.
PYTEST_SECONDS ?= 4800
LIMIT := $(if $(shell command -v timeout),timeout -k 30 $(PYTEST_SECONDS))
PYTEST_OPTIONS ?=

# Non-empty: a Blender version whose Python is absent fails `make test` instead of being left out.
STRICT ?=

.PHONY: help demo test test-fast lint tables lock clean bench soak extension test-blender test-gui test-farm test-page test-3.13 test-3.11
.NOTPARALLEL:

help:
	@echo 'make demo    shade the example scene, compare it with Cycles: out/demo/report.html, report.json'
	@echo 'make test    ruff, then pytest on Blender 5.2 (Python 3.13) and on Blender 4.5 (Python 3.11)'
	@echo 'make test-fast  the tests that need no Blender, on one Python'
	@echo 'make test-blender BLENDER=path  the tests of tests/blender inside that Blender'
	@echo 'make test-gui RUNNER=command  clicks through the extension in a Blender with a window, see tests/gui/README.md'
	@echo 'make test-farm   the Slurm scripts in farm/ on a Slurm of one machine (installs it where root on Debian)'
	@echo 'make test-page   pages and exported files in a headless browser, which comes from npm (installs node where root on Debian)'
	@echo 'make lint    ruff only'
	@echo 'make extension  the zips that Blender installs, one per platform: build/ltsh-*.zip'
	@echo 'make bench   what shading costs, beside a textbook LTC, zonal harmonics and Cycles (20 minutes or more)'
	@echo 'make soak    long tests, commands killed at random moments, 2,000 hostile inputs, 200 random scenes beside Cycles, 10,000 lights, 240 frames and 1e8 random integrals (hours)'
	@echo 'make tables  fit the lookup tables in tables/ again (long)'
	@echo 'make lock    resolve requirements/*.in into the lock files; LOCK_OPTIONS=--upgrade takes newer versions'
	@echo 'make clean   remove out/, build/ and caches (the environments in .venv stay)'

demo:
	@python=$$($(SETUP) python newest) && "$$python" -m ltsh_addon demo -o out/demo $(DEMO_OPTIONS)

# Two runs at once, as long as each other: the tests of Blender on the newest Python, and all others. The output of the
# second is kept and shown when the first has ended.
test: lint
	@mkdir -p build; \
	{ status=0; $(MAKE) --no-print-directory test-3.11 || status=$$?; \
	$(MAKE) --no-print-directory test-3.13 PART=core || status=$$?; exit $$status; } >build/test-others.log 2>&1 & second=$$!; \
	trap 'kill $$second 2>/dev/null' EXIT; \
	status=0; $(MAKE) --no-print-directory test-3.13 PART=blender || status=$$?; \
	echo 'make: waiting for the other tests' >&2; \
	wait $$second || status=$$?; \
	cat build/test-others.log; \
	exit $$status

lint:
	@python=$$($(SETUP) python newest) && "$$python" -m ruff check .

# What needs no Blender, or is marked `newest`, runs on the newest Python alone, but for a few tests of what may differ
# between versions. PART: of the newest Python only the tests that need Blender (blender), or that do not (core).
PART ?=
WHICH := $(if $(filter blender,$(PART)),blender and )$(if $(filter core,$(PART)),not blender and )not soak

test-3.13 test-3.11: test-%:
	@status=0; python=$$($(SETUP) python $*) || status=$$?; \
	if [ $$status -eq 0 ]; then \
		which='$(WHICH)'; [ "$$python" = "$$($(SETUP) python newest)" ] || which='(blender or smoke) and not (soak or newest)'; \
		$(LIMIT) "$$python" -m pytest -m "$$which" $(PYTEST_OPTIONS) || status=$$?; \
		[ $$status -ne 5 ] || [ -z '$(PART)' ] || [ -z '$(PYTEST_OPTIONS)' ] || status=0; \
		[ $$status -ne 124 ] || echo "make: pytest on Python $* was stopped after $(PYTEST_SECONDS) seconds" >&2; \
	elif [ $$status -eq 3 ]; then \
		echo "*** NOT TESTED: Python $* was not found, so its Blender version was left out." >&2; \
		echo "*** Install it (pyenv install $*, uv python install $*) or name it: LTSH_PYTHON_$(subst .,,$*)=..." >&2; \
		status=$(if $(STRICT),1,0); \
	fi; \
	exit $$status

test-fast:
	@python=$$($(SETUP) python newest) && $(LIMIT) "$$python" -m pytest --ignore=tests/blender $(PYTEST_OPTIONS)

BLENDER ?= blender

test-blender:
	@python=$$($(SETUP) python newest) && packages=$$($(SETUP) blender "$(BLENDER)") && \
	LTSH_TEST_PACKAGES=$$packages $(LIMIT) "$(BLENDER)" --background --factory-startup --disable-autoexec \
		--python tests/run_in_blender.py -- $(or $(PYTEST_OPTIONS),tests/blender) && \
	$(if $(PYTEST_OPTIONS),true,LTSH_BLENDER="$(BLENDER)" $(LIMIT) "$$python" -m pytest tests/installed)

test-gui:
	@python=$$($(SETUP) python newest) && "$$python" tests/gui/run_drivers.py --runner "$(RUNNER)" $(DRIVERS)

test-farm:
	@$(SETUP) slurm && python=$$($(SETUP) python newest) && \
	LTSH_TEST_SLURM=1 $(LIMIT) "$$python" -m pytest -s $(or $(PYTEST_OPTIONS),tests/farm)

test-page:
	@$(SETUP) browser >/dev/null && python=$$($(SETUP) python newest) && \
	$(LIMIT) "$$python" -m pytest -m 'soak or not soak' $(or $(PYTEST_OPTIONS),tests/page)

extension:
	@python=$$($(SETUP) python newest) && "$$python" -m requirements.build_extension $(EXTENSION_OPTIONS)

bench:
	@python=$$($(SETUP) python newest) && "$$python" tests/benchmarks/run.py $(BENCH_OPTIONS)

soak:
	@$(SETUP) browser >/dev/null && python=$$($(SETUP) python newest) && "$$python" -m pytest -m soak && "$$python" tests/soak/fuzz.py $(FUZZ_OPTIONS) && \
	LTSH_EACH=1000000 "$$python" -m pytest tests/lobes/test_lobe_robustness.py -k finite_numbers && \
	LTSH_MANY_LIGHTS=10000 "$$python" -m pytest tests/blender/pipeline/test_hostile_scenes.py -k many_lights && \
	"$$python" tests/benchmarks/animation.py shade $(ANIMATION_OPTIONS) && \
	"$$python" tests/benchmarks/animation.py render $(ANIMATION_OPTIONS)

tables:
	@python=$$($(SETUP) python newest) && "$$python" -m tables fit

lock:
	@$(SETUP) lock $(LOCK_OPTIONS)

clean:
	rm -rf out build .pytest_cache .ruff_cache .hypothesis
	find ltsh_addon tables tests -name __pycache__ -type d -prune -exec rm -rf {} +
