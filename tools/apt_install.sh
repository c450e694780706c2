#!/bin/sh
# Install missing Debian packages if this user may; otherwise print them and fail.
# usage: tools/apt_install.sh PACKAGE...
set -eu
missing=
for package; do
    if ! dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q 'ok installed'; then
        missing="$missing $package"
    fi
done
[ -n "$missing" ] || exit 0
if [ "$(id -u)" = 0 ]; then
    as_root=
elif sudo -n true 2>/dev/null; then
    as_root="sudo -n"
else
    echo "set-up: these packages are missing:$missing" >&2
    echo "set-up: install them with: sudo apt-get install --no-install-recommends$missing" >&2
    exit 1
fi
echo "set-up: installing Debian packages:$missing"
$as_root apt-get update -qq
# shellcheck disable=SC2086 # the list is meant to be split
DEBIAN_FRONTEND=noninteractive $as_root apt-get install -qq -y --no-install-recommends $missing \
    >/dev/null
