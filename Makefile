# Everything here sets itself up in .venv from a fresh clone: Python, make and a package index.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN := $(VENV)/.installed
STAMP := $(VENV)/.installed-test
OUT := .demo
# tests start many processes: bytecode is worth keeping
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test tests quick lint types campaigns benchmarks clean

## the main job: a spacecraft that has lost GPS finds itself in images formed with its own estimate
demo: $(RUN)
	@mkdir -p $(OUT)
	$(BIN)/terrafix run examples/spacecraft_sar_closed_loop.toml \
	    --set album.picture=$(CURDIR)/$(OUT)/closed_loop.png \
	    --out $(OUT)/closed_loop.nc --plot $(OUT)/errors.png
	@echo wrote $(OUT)/closed_loop.png

## all tests, with lint and types beside them
test: $(STAMP)
	@$(MAKE) --no-print-directory -j 2 tests lint types

tests: $(STAMP)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 --dist worksteal

## tests alone
quick: $(STAMP)
	$(BIN)/python -m pytest -q -n 2 --dist worksteal -x

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# an editable install is opaque to type checkers: lay the tree out as it would be installed
types: $(STAMP)
	@rm -rf build/types && mkdir -p build/types/terrafix
	@ln -s $(addprefix $(CURDIR)/,$(wildcard src/terrafix/*) components cosim models) \
	    build/types/terrafix
	MYPYPATH=build/types $(BIN)/mypy -p terrafix

## minutes-long Monte Carlo campaigns, in the numbers of the papers
campaigns: $(STAMP)
	$(BIN)/python -m pytest -q -m campaign -n 2

## the promised numbers, as ratios against a reference in the same run
benchmarks: $(STAMP)
	$(BIN)/python benchmarks/run.py
	$(BIN)/python benchmarks/campaign.py
	$(BIN)/python benchmarks/fmu.py
	$(BIN)/python benchmarks/imaging.py
	$(BIN)/python benchmarks/closed_loop.py
	$(BIN)/python benchmarks/maps.py
	$(BIN)/python benchmarks/closed_loop_figures.py
	$(BIN)/python benchmarks/closed_loop_long.py
	$(BIN)/python benchmarks/filters.py
	$(BIN)/python benchmarks/verdicts.py
	$(BIN)/python benchmarks/aircraft_images.py
	$(BIN)/python benchmarks/aircraft.py
	$(BIN)/python benchmarks/aircraft_flights.py --flights 2 --seconds 10
	$(BIN)/python benchmarks/real_orbit.py brahe kepler speed fmu
	@if test -d "$${TERRAFIX_DATA:-../shared/data}/sentinel1"; \
	    then $(BIN)/python benchmarks/real_orbit.py real filter; fi
	@if test -d "$${TERRAFIX_DATA:-../shared/data}/radarsat1_vancouver"; \
	    then $(BIN)/python benchmarks/real_echo.py; $(BIN)/python benchmarks/lost_lines.py; fi
	@if test -d "$${TERRAFIX_DATA:-../shared/data}/afrl_gotcha"; \
	    then $(BIN)/python benchmarks/gotcha.py; fi
	@if test -d "$${TERRAFIX_DATA:-../shared/data}/lakes_gshhg"; \
	    then $(BIN)/python benchmarks/lake.py; $(BIN)/python benchmarks/integer_contours.py; fi
	@if test -f "$${TERRAFIX_DATA:-../shared/data}/dem/mark_twain_ndvi_2025.tif"; \
	    then $(BIN)/python benchmarks/real_lake.py; fi
	$(BIN)/python benchmarks/geolocation.py

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(RUN): pyproject.toml setup.py | $(BIN)/python
	$(BIN)/python -m pip install -q --disable-pip-version-check -e .
	@touch $@

# most of what tests need is never imported: bytecode is made of the rest when it is
$(STAMP): pyproject.toml setup.py | $(BIN)/python
	$(BIN)/python -m pip install -q --disable-pip-version-check --no-compile -e '.[test]'
	@touch $(RUN) $@

clean:
	rm -rf $(VENV) build $(OUT) *.egg-info src/*.egg-info
