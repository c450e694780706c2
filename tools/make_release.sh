#!/bin/sh
# Make all files of a release from the last commit: source archive, wheels, Debian packages, image, bill
# of materials, checksums. Two runs give the same bytes, save the image, which contains Debian's newest
# packages.
# usage: tools/make_release.sh OUTPUT_FOLDER
# Needs .venv with the packages of requirements-dev.lock; a step that this machine cannot do is named.
set -eu
cd "$(dirname "$0")/.."
top=$PWD
mkdir -p "$1"
output=$(cd "$1" && pwd)
python=$top/.venv/bin/python
work=$(mktemp -d)
step_of=release
. tools/steps.sh
trap 'rm -rf "$work" "$step_log"' EXIT

if [ -n "$(git status --porcelain)" ]; then
    echo "release: only what is committed becomes part of it; commit or remove:" >&2
    git status --short >&2
    exit 1
fi
SOURCE_DATE_EPOCH=$(git log -1 --format=%ct)
export SOURCE_DATE_EPOCH
# The kernels are compiled from nothing, as the cache may have been made by another version of a tool.
export XDG_CACHE_HOME="$work/cache"
version=$("$python" -c 'import gateway; print(gateway.__version__)')
source=$work/mavgate-$version
git archive --prefix="mavgate-$version/" HEAD | tar -x -C "$work"

install() {
    "$python" -m pip install --quiet --disable-pip-version-check --require-hashes --no-deps "$@"
}
step "the packages that link, and list, what is released" install \
    --requirement requirements-linker.lock --requirement requirements-release.lock
step "firmware of the boards" make -C "$source/firmware" images

wheels() {
    for machine in x86_64 aarch64; do
        (cd "$source" && "$python" -m pip wheel --disable-pip-version-check --no-deps --no-build-isolation \
            --config-settings=--build-option=--plat-name=manylinux_2_17_"$machine" --wheel-dir "$output" .)
        rm -rf "$source/build" "$source"/*.egg-info
    done
}
step "wheels for x86-64 and aarch64" wheels

# A source archive has the metadata of the wheel.
source_archive() {
    unzip -p "$output/mavgate-$version-py3-none-manylinux_2_17_x86_64.whl" \
        "mavgate-$version.dist-info/METADATA" >"$work/PKG-INFO"
    git -c tar.umask=0022 archive --prefix="mavgate-$version/" --add-file="$work/PKG-INFO" HEAD |
        gzip -9 --no-name >"$output/mavgate-$version.tar.gz"
}
step "source archive" source_archive

for architecture in amd64 arm64; do
    for minor in 3.11 3.13; do
        step "Debian package for $architecture, Python $minor" tools/make_deb.sh "$output" "$architecture" "$minor"
    done
done

bill_of_materials() {
    entries=$work/requirements.txt
    cat requirements.lock >"$entries"
    "$python" -m cyclonedx_py requirements --output-reproducible --pyproject pyproject.toml \
        --mc-type application --output-format JSON --output-file "$output/mavgate-$version.cdx.json" "$entries"
}
step "bill of materials" bill_of_materials

rm -f "$output/mavgate-$version-oci.tar"
if command -v buildah >/dev/null && command -v mmdebstrap >/dev/null && [ "$(id -u)" = 0 ]; then
    step "image, for up to three minutes" tools/make_image.sh "$output"
else
    echo "release: no image, which needs buildah, mmdebstrap and root"
fi
cd "$output"
find . -maxdepth 1 -type f -name "mavgate*" -printf '%P\n' | LC_ALL=C sort | xargs sha256sum >SHA256SUMS
ls -l "$output"
