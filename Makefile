# make demo, make test: each sets up what is missing first (.ci/setup).

.PHONY: help demo test clean

help:
	@echo 'make demo    render the Cornell box by spherical harmonics and by path tracing into demo/'
	@echo 'make test    run the tests'
	@echo 'make clean   remove .venv, demo/ and build products'
	@echo 'Both set up what is missing: .venv, and LLVM >= 19 through apt where permitted.'

demo:
	@sh .ci/setup
	@.venv/bin/python -m mi_shlight compare scenes/cornell_box.xml -o demo

test:
	@sh .ci/setup
	@.venv/bin/python -m pytest tests -q

clean:
	rm -rf .venv build demo *.egg-info
	find mi_shlight plugins scenes tests validation -name __pycache__ -prune -exec rm -rf {} +
