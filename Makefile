# make demo, make test, make validate: each sets up what is missing first (.ci/setup).

.PHONY: help demo test validate clean

help:
	@echo 'make demo              render the Cornell box by spherical harmonics and by path tracing into demo/'
	@echo 'make test              run the tests'
	@echo 'make validate          run all experiments and write validation/results/report.html, in an hour and a half on two cores'
	@echo 'make validate QUICK=1  try all of them at tiny sizes, in minutes, into build/validation-quick/'
	@echo 'make clean             remove .venv, demo/ and build products'
	@echo 'All but the last set up what is missing: .venv, and LLVM >= 19 through apt where permitted.'

demo:
	@sh .ci/setup
	@.venv/bin/python -m mi_shlight compare scenes/cornell_box.xml -o demo

test:
	@sh .ci/setup browser
	@.venv/bin/python -m pytest tests -q -n auto --maxprocesses 8 --dist loadfile

validate:
	@sh .ci/setup
	@.venv/bin/python -m validation $(if $(QUICK),--quick)

clean:
	rm -rf .venv build demo *.egg-info
	find mi_shlight plugins scenes tests validation -name __pycache__ -prune -exec rm -rf {} +
