#!/bin/sh
# Make an image of Debian with mavgate's package, as an archive of the Open Container Initiative, without
# a registry of images.
# usage: tools/make_image.sh FOLDER    FOLDER has the package for amd64 and Python 3.11
set -eu
output=$1
work=$(mktemp -d)
trap 'rm -rf "$work"; [ -z "${made:-}" ] || buildah rm "$made" >/dev/null' EXIT
package=$(ls "$output"/mavgate_*+deb12_amd64.deb)
version=$(dpkg-deb --field "$package" Version)

mmdebstrap --variant=minbase --mode=root --skip=check/chroot --dpkgopt=path-exclude='/usr/share/man/*' \
    --include=python3,libstdc++6,systemd-standalone-sysusers \
    --customize-hook="upload '$package' /mavgate.deb" \
    --customize-hook='chroot "$1" dpkg --install /mavgate.deb' \
    --customize-hook='rm "$1/mavgate.deb"' bookworm "$work/root.tar"
made=$(buildah from scratch)
buildah add "$made" "$work/root.tar" / >/dev/null
buildah config --user mavgate --volume /var/lib/mavgate --env PYTHONUNBUFFERED=1 \
    --env XDG_STATE_HOME=/var/lib/mavgate --entrypoint '["mavgate"]' --cmd 'run --plain' \
    --label org.opencontainers.image.version="$version" --label org.opencontainers.image.licenses=Apache-2.0 "$made"
buildah commit --quiet --disable-compression=false --timestamp "${SOURCE_DATE_EPOCH:-$(date +%s)}" "$made" \
    "oci-archive:$output/mavgate-${version%+*}-oci.tar:localhost/mavgate:latest"
