#!/bin/sh
# Build a Debian package that holds mavgate with every locked package it needs: it installs without
# a network, beside Debian's own Python packages, and runs with the Python version that it was built
# with.
# usage: tools/make_deb.sh OUTPUT_FOLDER
# PYTHON names the interpreter (with pip and setuptools); LOCK= leaves the dependencies out.
set -eu
cd "$(dirname "$0")/.."
output=$1
python=${PYTHON:-.venv/bin/python}
lock=${LOCK-requirements.lock}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
root=$work/root
lib=$root/usr/lib/mavgate

# From a copy: setuptools would also pack what an earlier build left in the tree.
mkdir -p "$work/source"
cp -r gateway config docs tools pyproject.toml README.md CHANGELOG.md LICENSE "$work/source"
find "$work/source" -name __pycache__ -prune -exec rm -r {} +

install() {
    "$python" -m pip install --quiet --disable-pip-version-check --no-compile --no-deps \
        --target "$lib" "$@"
}
install --no-build-isolation "$work/source"
mv "$lib/share" "$work/"
rm -rf "$lib/bin" "$lib"/mavgate-*.dist-info/direct_url.json
[ -z "$lock" ] || install --requirement "$lock"
rm -rf "$lib/bin" "$lib/share"
# A seventh of all that it would install are the tests of other packages.
find "$lib" -type d -name tests -prune -exec rm -r {} +
version=$(PYTHONPATH=$lib "$python" -c 'import gateway; print(gateway.__version__)')
minor=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
next=${minor%.*}.$((${minor#*.} + 1))

mkdir -p "$root/usr/bin" "$root/usr/lib/systemd/system" "$root/usr/lib/sysusers.d" \
    "$root/usr/lib/udev/rules.d" "$root/etc/mavgate" "$root/usr/share/doc" "$root/DEBIAN"
sed "s/@MINOR@/$minor/" tools/debian/mavgate > "$root/usr/bin/mavgate"
chmod 755 "$root/usr/bin/mavgate"
mv "$work/share/doc/mavgate" "$root/usr/share/doc/"
cp LICENSE "$root/usr/share/doc/mavgate/copyright"
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
# As Debian does it, so that nothing is compiled anew on a machine that cannot write there.
"$python" -m compileall -q -s "$root" --invalidation-mode unchecked-hash "$lib"

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
dpkg-deb --root-owner-group -Zzstd -z6 --build "$root" "$output"
