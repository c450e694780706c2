#!/bin/sh
# Build a Debian package that contains mavgate with every locked package it needs: it installs
# without a network, separate from Debian's own Python packages, and runs with the Python version
# with which it was built.
# usage: tools/make_deb.sh OUTPUT_FOLDER
# PYTHON names the interpreter (with pip and setuptools); LOCK= leaves the dependencies out.
set -eu
cd "$(dirname "$0")/.."
output=$1
python=${PYTHON:-.venv/bin/python}
lock=${LOCK-requirements.lock}
work=$(mktemp -d)
root=$work/root
lib=$root/usr/lib/mavgate

step_of=package
. tools/steps.sh
trap 'rm -rf "$work" "$step_log"' EXIT

install() {
    "$python" -m pip install --disable-pip-version-check --no-compile --no-deps --target "$lib" "$@"
}

# From a copy, since setuptools would also pack files of an earlier build in the tree.
mkdir -p "$work/source"
cp -r gateway config docs tools pyproject.toml setup.py README.md CHANGELOG.md LICENSE "$work/source"
find "$work/source" -name __pycache__ -prune -exec rm -r {} +
step "mavgate and its compiled kernels" install --no-build-isolation "$work/source"
mv "$lib/share" "$work/"
rm -rf "$lib/bin" "$lib"/mavgate-*.dist-info/direct_url.json
[ -z "$lock" ] || step "$(grep -c '^[A-Za-z]' "$lock") packages of $lock" \
    install --require-hashes --requirement "$lock"
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
if command -v strip >/dev/null; then
    find "$lib" -name "*.so" ! -path "*.libs/*" -exec strip --strip-unneeded {} +
fi
version=$(PYTHONPATH=$lib "$python" -c 'import gateway; print(gateway.__version__)')
minor=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
next=${minor%.*}.$((${minor#*.} + 1))

mkdir -p "$root/usr/bin" "$root/usr/lib/systemd/system" "$root/usr/lib/sysusers.d" \
    "$root/usr/lib/udev/rules.d" "$root/etc/mavgate" "$root/usr/share/doc" "$root/DEBIAN"
sed "s/@MINOR@/$minor/" tools/debian/mavgate > "$root/usr/bin/mavgate"
chmod 755 "$root/usr/bin/mavgate"
mv "$work/share/doc/mavgate" "$root/usr/share/doc/"
{
    printf 'mavgate (%s) unstable; urgency=medium\n\n' "$version"
    printf '  * CHANGELOG.md in this folder lists the changes.\n\n'
    printf ' -- the mavgate project <mavgate@localhost>  %s\n' "$(date -R)"
} | gzip -9 --no-name > "$root/usr/share/doc/mavgate/changelog.gz"
mkdir -p "$root/usr/share/man/man1"
gzip -9 --no-name --stdout tools/debian/mavgate.1 > "$root/usr/share/man/man1/mavgate.1.gz"
"$python" -m tools.third_party --copyright "$root/usr/share/doc/mavgate/copyright" "$lib"
mv "$work/share/mavgate/mavgate.service" "$root/usr/lib/systemd/system/"
cp tools/debian/60-mavgate.rules "$root/usr/lib/udev/rules.d/"
cp tools/debian/sysusers.conf "$root/usr/lib/sysusers.d/mavgate.conf"
PYTHONPATH=$lib "$python" tools/debian/service_settings.py > "$root/etc/mavgate/gateway.toml"
for shell in bash zsh fish; do
    case $shell in
        bash) file=usr/share/bash-completion/completions/mavgate ;;
        zsh) file=usr/share/zsh/vendor-completions/_mavgate ;;
        fish) file=usr/share/fish/vendor_completions.d/mavgate.fish ;;
    esac
    mkdir -p "$(dirname "$root/$file")"
    _MAVGATE_COMPLETE=source_$shell PYTHONPATH=$lib "$python" "$root/usr/bin/mavgate" \
        > "$root/$file"
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
sed -e "s/@VERSION@/$version/" -e "s/@ARCHITECTURE@/$(dpkg --print-architecture)/" \
    -e "s/@MINOR@/$minor/" -e "s/@NEXT@/$next/" -e "s/@SIZE@/$(du -sk "$root" | cut -f1)/" \
    tools/debian/control > "$root/DEBIAN/control"
chmod -R go=u-w "$root"
mkdir -p "$output"
step "compression, for up to two minutes" dpkg-deb --root-owner-group -Zxz --build "$root" "$output"
ls -l "$output"/mavgate_*.deb
