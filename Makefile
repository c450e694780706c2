# make demo   the gateway on its built-in simulated receiver, until interrupted
# make test   every test, the firmware's included
# make kernels  the compiled kernels, if their sources have changed
# make wheel  wheels for x86-64 and aarch64, in dist/
# make image  an OCI image of the Debian package, as an archive in dist/
# make lint   formatting, lint and types
# make firmware   the ready-made images of `mavgate flash`; make deb builds them too
# make deb    a Debian package with the service, in dist/
# make release  all files of a release, from the last commit, in dist/
# make try-release  use each file of dist/ as its user would, in fresh Debian systems
# make fuzz   random and damaged input to every reader, for five minutes
# make lock   resolve the dependencies of pyproject.toml and write the lock files

.PHONY: demo kernels test lint deb wheel image release try-release fuzz lock firmware clean

BROWSER_PACKAGES := chromium
COMPILER_PACKAGES := make gcc-avr binutils-avr avr-libc
FIRMWARE_PACKAGES := $(COMPILER_PACKAGES) g++ libsimavr-dev cppcheck avrdude arduino-core-avr
RELEASE_PACKAGES := unzip binutils-aarch64-linux-gnu buildah mmdebstrap
TRIAL_PACKAGES := mmdebstrap arch-test qemu-user-static binfmt-support

demo: kernels
	.venv/bin/mavgate demo

kernels: .venv/.run
	@.venv/bin/python -m tools.build_kernels --check || tools/set_up.sh

# Tests that need the AVR tool chain or a browser skip, and say so, where it could not be installed.
# Tests wait for a third of their time, so there are four workers for two cores. They start hundreds of
# processes, each of which would compile all sources again without bytecode files.
test: export PYTHONDONTWRITEBYTECODE =
test: .venv/.dev kernels
	-@tools/apt_install.sh $(FIRMWARE_PACKAGES)
	-@tools/apt_install.sh $(BROWSER_PACKAGES)
	.venv/bin/pytest -q -n 4 --durations 20

lint: .venv/.dev
	.venv/bin/pre-commit run --all-files

# Each wheel contains the kernels for its processor, and runs with any supported version of Python.
wheel: .venv/.dev
	@.venv/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes --no-deps \
		--requirement requirements-linker.lock
	for machine in x86_64 aarch64; do \
		.venv/bin/python -m pip wheel --disable-pip-version-check --no-deps --no-build-isolation \
			--config-settings=--build-option=--plat-name=manylinux_2_17_$$machine \
			--wheel-dir dist . || exit; \
	done

image: deb
	tools/apt_install.sh buildah mmdebstrap
	tools/make_image.sh dist

deb: firmware wheel
	tools/make_deb.sh dist

release: .venv/.dev
	-@tools/apt_install.sh $(COMPILER_PACKAGES) $(RELEASE_PACKAGES)
	tools/make_release.sh dist

try-release: .venv/.dev
	-@tools/apt_install.sh $(TRIAL_PACKAGES)
	tools/try_release.sh dist

fuzz: .venv/.dev
	.venv/bin/python -m tools.fuzz

lock: .venv/.dev
	$(COMPILE) --extra panel --extra fleet --output-file requirements.lock pyproject.toml
	$(COMPILE) --group build --constraint requirements.lock --output-file requirements-build.lock
	$(COMPILE) --group linker --output-file requirements-linker.lock
	$(COMPILE) --group release --output-file requirements-release.lock
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
	@tools/set_up.sh requirements.lock
	@touch $@

.venv/.dev: requirements-dev.lock pyproject.toml
	@tools/set_up.sh requirements-dev.lock
	@touch .venv/.run $@
