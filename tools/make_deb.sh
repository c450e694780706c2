#!/bin/sh
# Build a Debian package of the wheel of mavgate in a folder, with every locked package it needs: it
# installs without a network, separate from Debian's own Python packages, and runs with one version of
# Python.
# usage: tools/make_deb.sh FOLDER [ARCHITECTURE [PYTHON_VERSION]]
# By default for this machine and for the interpreter of .venv. PYTHON names another one (with pip); LOCK=
# leaves the dependencies out.
set -eu
cd "$(dirname "$0")/.."
output=$(cd "$1" && pwd)
architecture=${2:-$(dpkg --print-architecture)}
python=${PYTHON:-.venv/bin/python}
lock=${LOCK-requirements.lock}
export SOURCE_DATE_EPOCH="${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)}"
work=$(mktemp -d)
root=$work/root
lib=$root/usr/lib/mavgate

step_of=package
. tools/steps.sh
trap 'rm -rf "$work" "$step_log"' EXIT

minor=${3:-$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')}
next=${minor%.*}.$((${minor#*.} + 1))
case $minor in
    3.11) debian=12 ;;
    3.13) debian=13 ;;
    *) debian=0 ;;
esac
case $architecture in
    amd64) machine=x86_64 ;;
    arm64) machine=aarch64 ;;
    *) echo "package: no wheels are made for $architecture; use amd64 or arm64" >&2; exit 1 ;;
esac

install() {
    # shellcheck disable=SC2046 # the list is meant to be split
    "$python" -m pip install --disable-pip-version-check --no-compile --no-deps --target "$lib" \
        --ignore-requires-python $(wheels_for "$machine" "$minor") "$@"
}

step "mavgate and its compiled kernels" install "$output"/mavgate-*_"$machine".whl
mv "$lib/share" "$work/"
rm -rf "$lib/bin" "$lib"/mavgate-*.dist-info/direct_url.json
if [ -n "$lock" ]; then
    # There is no wheel of cobs. Without its compiled part, which is that of this machine, it is Python.
    "$python" -m tools.locked_for "$lock" "$minor" "$machine" --without cobs >"$work/wheels.lock"
    "$python" -m tools.locked_for "$lock" "$minor" "$machine" --only cobs >"$work/sources.lock"
    step "$(grep -c '^[A-Za-z]' "$work/wheels.lock") packages of $lock" \
        install --require-hashes --requirement "$work/wheels.lock"
    step "and cobs" "$python" -m pip install --disable-pip-version-check --no-compile --no-deps \
        --target "$lib" --require-hashes --requirement "$work/sources.lock"
    here="$(dpkg --print-architecture) $("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')"
    [ "$architecture $minor" = "$here" ] || find "$lib/cobs" -name "*.so" -delete
fi
rm -rf "$lib/bin" "$lib/share"
# A third of the files would be tests of other packages, types, C sources, and MAVLink dialects that
# `all` includes.
find "$lib" -type d -name tests -prune -exec rm -r {} +
find "$lib" -name "*_tests.*.so" -delete
find "$lib" -type f \( -name "*.pyi" -o -name "*.pyx" -o -name "*.pxd" -o -name "*.[ch]" \) -delete
dialects=$lib/pymavlink/dialects
if [ -d "$dialects" ]; then
    find "$dialects" -type f ! -name __init__.py ! -path "$dialects/v20/all.*" -delete
fi
# Not the libraries in folders *.libs, which were changed after linking and would become invalid.
strip=$machine-linux-gnu-strip
if command -v "$strip" >/dev/null; then
    find "$lib" -name "*.so" ! -path "*.libs/*" -exec "$strip" --strip-unneeded {} +
else
    echo "package: without $strip it is larger" >&2
fi
version=$("$python" -c 'import gateway; print(gateway.__version__)')+deb$debian

mkdir -p "$root/usr/bin" "$root/usr/lib/systemd/system" "$root/usr/lib/sysusers.d" \
    "$root/usr/lib/udev/rules.d" "$root/etc/mavgate" "$root/usr/share/doc" "$root/DEBIAN"
sed "s/@MINOR@/$minor/" tools/debian/mavgate > "$root/usr/bin/mavgate"
chmod 755 "$root/usr/bin/mavgate"
mv "$work/share/doc/mavgate" "$root/usr/share/doc/"
{
    printf 'mavgate (%s) unstable; urgency=medium\n\n' "$version"
    printf '  * CHANGELOG.md in this folder lists the changes.\n\n'
    printf ' -- the mavgate project <mavgate@localhost>  %s\n' "$(date -R -u -d "@$SOURCE_DATE_EPOCH")"
} | gzip -9 --no-name > "$root/usr/share/doc/mavgate/changelog.gz"
mkdir -p "$root/usr/share/man/man1"
"$python" -m tools.make_man | gzip -9 --no-name > "$root/usr/share/man/man1/mavgate.1.gz"
"$python" -m tools.third_party --copyright "$root/usr/share/doc/mavgate/copyright" "$lib"
mv "$work/share/mavgate/mavgate.service" "$root/usr/lib/systemd/system/"
cp tools/debian/60-mavgate.rules "$root/usr/lib/udev/rules.d/"
cp tools/debian/sysusers.conf "$root/usr/lib/sysusers.d/mavgate.conf"
"$python" -m tools.debian.service_settings > "$root/etc/mavgate/gateway.toml"
for shell in bash zsh fish; do
    case $shell in
        bash) file=usr/share/bash-completion/completions/mavgate ;;
        zsh) file=usr/share/zsh/vendor-completions/_mavgate ;;
        fish) file=usr/share/fish/vendor_completions.d/mavgate.fish ;;
    esac
    mkdir -p "$(dirname "$root/$file")"
    _MAVGATE_COMPLETE=source_$shell "$(dirname "$python")/mavgate" > "$root/$file"
done
# Bytecode that Python wrote when this script ran the program; the installation writes its own.
find "$root" -name __pycache__ -prune -exec rm -r {} +
find "$lib" -type f -exec chmod 644 {} +
# Some modules begin with the path of a Python interpreter that Debian does not have.
find "$lib" -name "*.py" -exec sed -i '1s|^#!.*python.*$|#!/usr/bin/python3|' {} +
mkdir -p "$root/usr/share/lintian/overrides"
cp tools/debian/lintian-overrides "$root/usr/share/lintian/overrides/mavgate"
echo /etc/mavgate/gateway.toml > "$root/DEBIAN/conffiles"
for script in postinst prerm postrm; do
    cp "tools/debian/$script" "$root/DEBIAN/"
    chmod 755 "$root/DEBIAN/$script"
done
sed -e "s/@VERSION@/$version/" -e "s/@ARCHITECTURE@/$architecture/" \
    -e "s/@MINOR@/$minor/" -e "s/@NEXT@/$next/" -e "s/@SIZE@/$(du -sk "$root" | cut -f1)/" \
    tools/debian/control > "$root/DEBIAN/control"
chmod -R go=u-w "$root"
step "compression" dpkg-deb --root-owner-group -Zzstd -z9 --build "$root" "$output"
ls -l "$output/mavgate_${version}_$architecture.deb"
