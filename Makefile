# Two commands: `make quickstart` and `make test`. Each first sets up what it needs; later runs skip that.
#   make PYTHON=/path/to/python3.12 …   uses this interpreter instead of the first one found

.PHONY: help install demo quickstart thesis test lint benchmarks clean

help:
	@echo "make quickstart   environment, demonstrations, conversion, training, evaluation, report"
	@echo "make thesis       the thesis' size, trained on a GPU and evaluated; MINUTES=60 is how long it may take"
	@echo "make demo         environment, five chains of the benchmark with a policy that is already trained"
	@echo "make test         environment, all tests"
	@echo "make install      environment only: .venv with the plugin installed editable"
	@echo "make lint         ruff and mypy"
	@echo "make benchmarks   speed of desk, recorder, converter, policy and training; ASSETS=DIR: on CALVIN's files too"
	@echo "make clean        removes .venv, outputs and data/quickstart"

install: .venv/.installed

.venv/.installed: pyproject.toml constraints.txt scripts/install.sh scripts/find_python.sh
	@PYTHON="$(PYTHON)" sh scripts/install.sh

quickstart: install
	@.venv/bin/python scripts/quickstart.py

thesis: install
	@.venv/bin/python scripts/thesis.py --minutes=$(or $(MINUTES),60)

demo: install
	@HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 .venv/bin/lansar-eval \
		--policy.path="$$(.venv/bin/lansar-path checkpoints/desk-d)" --env.type=calvin --env.control_mode=abs \
		--env.cameras='[]' --env.render_fps=6 \
		--chains=5 --seed=0 --output_dir=outputs/demo
	@.venv/bin/lansar-report --eval_dir=outputs/demo
	@echo "the page, with all videos, to open in a browser: outputs/demo/report.html"

test: install
	@.venv/bin/python -m pytest -n auto --maxprocesses 8 --dist loadfile --no-loadscope-reorder --durations=25

lint: install
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

benchmarks: install
	.venv/bin/python benchmarks/desk.py --output=outputs/benchmarks/desk.json
	$(if $(ASSETS),.venv/bin/python benchmarks/desk.py --assets=$(ASSETS) --output=outputs/benchmarks/desk_original.json)
	.venv/bin/python benchmarks/recording.py --output=outputs/benchmarks/recording.json
	.venv/bin/python benchmarks/convert.py --output=outputs/benchmarks/convert.json
	.venv/bin/python benchmarks/latency.py --output=outputs/benchmarks/latency.json
	.venv/bin/python benchmarks/training.py --output=outputs/benchmarks/training.json

clean:
	rm -rf .venv outputs data/quickstart
