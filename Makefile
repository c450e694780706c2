# make demo   the gateway on its built-in simulated receiver, until interrupted
# make test   every test, the firmware's included
# make kernels  the compiled kernels, if their sources have changed
# make coverage  the lines of each package that the quick tests run, without a threshold
# make wheel  wheels for x86-64 and aarch64, in dist/
# make image  an OCI image, with podman, buildah or docker; BASE= names another base than Python's
# make lint   formatting, lint and types
# make firmware   the ready-made images of `mavgate flash`; make deb builds them too
# make deb    a Debian package with the service, in dist/
# make fuzz   random and damaged input to every reader, for five minutes
# make lock   resolve the dependencies of pyproject.toml and write the lock files

.PHONY: demo kernels test coverage lint deb wheel image fuzz lock firmware clean

BROWSER_PACKAGES := chromium
COMPILER_PACKAGES := make gcc-avr binutils-avr avr-libc
FIRMWARE_PACKAGES := $(COMPILER_PACKAGES) g++ libsimavr-dev cppcheck avrdude arduino-core-avr

demo: kernels
	.venv/bin/mavgate demo

kernels: .venv/.run
	@.venv/bin/python -m tools.build_kernels

# Tests that need the AVR tool chain or a browser skip, and say so, where it could not be installed.
# Tests wait for a third of their time, so there are four workers for two cores. They start hundreds of
# processes, each of which would compile all sources again without bytecode files.
test: export PYTHONDONTWRITEBYTECODE =
test: .venv/.dev kernels
	-@tools/apt_install.sh $(FIRMWARE_PACKAGES)
	-@tools/apt_install.sh $(BROWSER_PACKAGES)
	.venv/bin/pytest -q -n 4 --durations 20

# Before Python 3.12 tracing makes the tests take 2.7 times the processor time, from then on little more:
# so it is apart from `make test`, and without the slow tests, most of which start other processes. A test
# that fails only while it is traced is too slow then, which says nothing of the code.
coverage: export PYTHONDONTWRITEBYTECODE =
coverage: .venv/.dev kernels
	-COVERAGE_CORE=$$(.venv/bin/python -c 'import sys; print("sysmon" if sys.version_info >= (3, 12) else "ctrace")') \
		.venv/bin/pytest -q -n 2 -m "not slow" --cov=gateway --cov-report=
	@.venv/bin/python -m tools.coverage_by_package

lint: .venv/.dev
	.venv/bin/pre-commit run --all-files

# Each wheel contains the kernels for its processor, and runs with any supported version of Python.
wheel: .venv/.run
	@.venv/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes --no-deps \
		--requirement requirements-linker.lock
	for machine in x86_64 aarch64; do \
		.venv/bin/python -m pip wheel --disable-pip-version-check --no-deps --no-build-isolation \
			--config-settings=--build-option=--plat-name=manylinux_2_17_$$machine \
			--wheel-dir dist . || exit; \
	done

image:
	$(firstword $(shell command -v podman buildah docker) podman) build --tag mavgate \
		$(if $(BASE),--build-arg BASE=$(BASE)) .

deb: .venv/.run firmware
	tools/make_deb.sh dist

fuzz: .venv/.dev
	.venv/bin/python -m tools.fuzz

lock: .venv/.dev
	$(COMPILE) --extra panel --extra fleet --output-file requirements.lock pyproject.toml
	$(COMPILE) --group build --constraint requirements.lock --output-file requirements-build.lock
	$(COMPILE) --group linker --output-file requirements-linker.lock
	$(COMPILE) --all-extras --group build --constraint requirements.lock $(HEADLESS) \
		--output-file requirements-dev.lock pyproject.toml
	.venv/bin/python -m tools.third_party

COMPILE = .venv/bin/uv pip compile --quiet $(UPGRADE) --universal --generate-hashes --no-header \
	--no-emit-index-url --no-emit-find-links
# UPGRADE= keeps the versions that are locked.
UPGRADE = --upgrade

# Packages with which MAVProxy draws windows and maps: half a gigabyte that no test uses.
HEADLESS := $(foreach package,opencv-python vtk wxpython quantized-mesh-tile shapely, \
	--no-emit-package $(package))

firmware:
	tools/apt_install.sh $(COMPILER_PACKAGES)
	$(MAKE) -C firmware images

clean:
	rm -rf .venv build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache

.venv/.run: requirements.lock requirements-build.lock pyproject.toml
	@tools/set_up.sh requirements.lock requirements-build.lock
	@touch $@

.venv/.dev: requirements-dev.lock pyproject.toml
	@tools/set_up.sh requirements-dev.lock
	@touch .venv/.run $@
