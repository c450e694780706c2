#!/bin/sh
# Use each file of a release as its user would, in fresh Debian systems without a network.
# usage: tools/try_release.sh FOLDER [TRIAL...]
# FOLDER is the output of tools/make_release.sh; trials: bookworm trixie arm64 tests. Needs root and
# mmdebstrap; for arm64 and tests qemu-user-static and binfmt_misc, which it mounts. The systems stay in
# build/roots for the next run. A trial that this machine cannot do is named.
set -eu
cd "$(dirname "$0")/.."
release=$(cd "$1" && pwd)
shift
trials=${*:-bookworm trixie arm64 tests}
python=$PWD/.venv/bin/python
roots=$PWD/build/roots
wheels=$PWD/build/wheels
test_packages=" pytest pytest-asyncio pytest-xdist execnet pluggy iniconfig hypothesis sortedcontainers packaging pygments crsf-parser construct-typing typing-extensions pynmeagps "
mkdir -p "$roots" "$wheels"
. tools/steps.sh
trap 'rm -f "$step_log"' EXIT

skip() {
    echo "$1: skipped: $2"
}

# Download the locked packages for a processor and a version of Python.
download() {
    folder=$wheels/$1-$2
    [ ! -e "$folder/complete" ] || return 0
    mkdir -p "$folder"
    # Two have no wheel.
    # shellcheck disable=SC2086 # the list is meant to be split
    {
        "$python" -m tools.locked_for requirements.lock "$2" "$1" --without cobs
        "$python" -m tools.locked_for requirements-build.lock "$2" "$1" --only setuptools
        "$python" -m tools.locked_for requirements-dev.lock "$2" "$1" --only $test_packages
    } >"$folder/wheels.lock"
    "$python" -m tools.locked_for requirements-dev.lock "$2" "$1" --only cobs construct >"$folder/sources.lock"
    # shellcheck disable=SC2046 # the list is meant to be split
    "$python" -m pip download --quiet --disable-pip-version-check --no-deps $(wheels_for "$1" "$2") \
        --require-hashes --requirement "$folder/wheels.lock" --dest "$folder" 2>"$folder/log" ||
        { cat "$folder/log" >&2; exit 1; }
    "$python" -m pip download --quiet --disable-pip-version-check --no-deps --no-binary=:all: --no-build-isolation \
        --require-hashes --requirement "$folder/sources.lock" --dest "$folder" 2>"$folder/log" ||
        { cat "$folder/log" >&2; exit 1; }
    touch "$folder/complete"
}

# A fresh system, from a stored one: make_root NAME RELEASE ARCHITECTURE
make_root() {
    if [ ! -e "$roots/$1.tar" ]; then
        echo "$1: making a Debian system, for up to eight minutes"
        mmdebstrap --quiet --variant=minbase --architectures="$3" \
            --include=python3,python3-venv,libstdc++6,systemd-standalone-sysusers "$2" "$roots/$1.tar"
    fi
    rm -rf "${roots:?}/$1"
    mkdir "$roots/$1"
    tar -x -C "$roots/$1" -f "$roots/$1.tar"
    cp tools/try_installed.py "$roots/$1/"
}

# Run a command in a system, with no network but loopback.
in_root() {
    root=$1
    shift
    # shellcheck disable=SC2016 # expanded by the inner shell
    unshare --mount --net --pid --fork sh -c '
        ip link set lo up && mount -t proc proc "$0/proc" && mount --rbind /dev "$0/dev" &&
        exec chroot "$0" env -i HOME=/root PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin "$@"
    ' "$root" "$@"
}

# Install the wheel in an empty environment: try_wheel ROOT MACHINE PYTHON_VERSION
try_wheel() {
    download "$2" "$3"
    cp -r "$wheels/$2-$3" "$1/wheels"
    cp "$release"/mavgate-*_"$2".whl requirements.lock "$1/wheels/"
    in_root "$1" sh -ec '
        python3 -m venv /opt/mavgate
        pip="/opt/mavgate/bin/pip --disable-pip-version-check install --quiet --no-index --find-links /wheels"
        $pip --no-compile --no-deps --require-hashes --requirement /wheels/requirements.lock
        $pip --no-compile --no-deps /wheels/mavgate-*.whl'
    [ -z "${recorded:-}" ] || cp -r "$recorded" "$1/recorded"
    in_root "$1" /opt/mavgate/bin/python /try_installed.py /try --mavgate /opt/mavgate/bin/mavgate \
        ${recorded:+--recorded /recorded}
}

# Install the package, run its service as systemd would, and purge it: try_package ROOT DEBIAN ARCHITECTURE
try_package() {
    cp "$release"/mavgate_*+"$2_$3".deb "$1/mavgate.deb"
    in_root "$1" sh -ec '
        dpkg --install /mavgate.deb >/dev/null
        size=$(du -sm /usr/lib/mavgate | cut -f1)
        echo "installed_mb $size"
        install -d -o mavgate -g mavgate /run/mavgate /var/lib/mavgate
        start=$(sed -n "s/^ExecStart=//p" /usr/lib/systemd/system/mavgate.service)
        cd /
        as_service="setpriv --reuid mavgate --regid mavgate --init-groups env HOME=/var/lib/mavgate \
            RUNTIME_DIRECTORY=/run/mavgate STATE_DIRECTORY=/var/lib/mavgate"
        $as_service $start >/service.log 2>&1 &
        service=$!
        for _ in $(seq 120); do
            [ ! -S /run/mavgate/run.sock ] || break
            sleep 0.5
        done
        mavgate status >/status.log || { cat /service.log /status.log; exit 1; }
        $as_service mavgate doctor --config /etc/mavgate/gateway.toml >/doctor.log 2>&1 ||
            { cat /doctor.log; exit 1; }
        mavgate record start >/dev/null
        python3 -c "import socket, sys, time; sys.path.insert(0, \"/\"); import try_installed as trial
vehicle = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for number in range(20):
    vehicle.sendto(trial.heartbeat(), (\"127.0.0.1\", 14551))
    vehicle.sendto(trial.numbered(number), (\"127.0.0.1\", 14551))
    time.sleep(0.1)"
        mavgate record stop >/dev/null
        kill -TERM $service
        wait $service || { echo "the service ended with exit code $?"; cat /service.log; exit 1; }
        dpkg --remove mavgate >/dev/null 2>&1
        [ -e /etc/mavgate/gateway.toml ]
        dpkg --purge mavgate >/dev/null 2>&1
        [ ! -e /usr/lib/mavgate ] && [ ! -e /etc/mavgate/gateway.toml ]
        [ -d /var/lib/mavgate ]
        ls /var/lib/mavgate/recordings/ | grep -q .
        echo "package installed, service run and stopped, purged; recordings kept"'
}

# Debian's release, its version of Python and its package: try_system NAME ARCHITECTURE MACHINE
try_system() {
    case $1 in
        trixie*) debian=trixie minor=3.13 package=deb13 ;;
        *) debian=bookworm minor=3.11 package=deb12 ;;
    esac
    make_root "$1" "$debian" "$2"
    echo "$1: wheel with Python $minor"
    try_wheel "$roots/$1" "$3" "$minor"
    echo "$1: Debian package"
    try_package "$roots/$1" "$package" "$2"
}

emulated() {
    [ "$(uname -m)" != aarch64 ] || return 0
    [ -e /proc/sys/fs/binfmt_misc/register ] ||
        mount -t binfmt_misc binfmt_misc /proc/sys/fs/binfmt_misc 2>/dev/null || return 1
    update-binfmts --enable qemu-aarch64 2>/dev/null && [ -e /proc/sys/fs/binfmt_misc/qemu-aarch64 ]
}

(cd "$release" && sha256sum --quiet --check SHA256SUMS)
if [ "$(id -u)" != 0 ] || ! command -v mmdebstrap >/dev/null; then
    skip "all trials" "they need root and mmdebstrap"
    exit 0
fi
for trial in $trials; do
    case $trial in
        bookworm | trixie) try_system "$trial" amd64 x86_64 ;;
        arm64)
            if ! emulated; then
                skip arm64 "needs qemu-user-static and binfmt_misc"
                continue
            fi
            # The states of the other processor are compared with those of this one.
            [ ! -d "$roots/bookworm/try" ] || recorded=$roots/bookworm/try
            try_system arm64 arm64 aarch64
            recorded=
            ;;
        tests)
            if [ ! -d "$roots/arm64/opt/mavgate" ]; then
                skip tests "they run in the system of the trial arm64"
                continue
            fi
            mkdir -p "$roots/arm64/source"
            cp -r tests tools config docs firmware pyproject.toml README.md Makefile "$roots/arm64/source/"
            in_root "$roots/arm64" sh -ec '
                /opt/mavgate/bin/pip --disable-pip-version-check install --quiet --no-index --no-deps \
                    --find-links /wheels --no-compile $0 construct
                cd /source
                /opt/mavgate/bin/python -m pytest -q -n 2 -m "not slow" -p no:cacheprovider \
                    --ignore tests/vehicle/services/test_ftp.py \
                    tests/wire tests/geometry tests/sensing tests/vehicle tests/sources
            ' "$test_packages"
            ;;
        *) echo "no trial $trial; use bookworm, trixie, arm64 or tests" >&2; exit 1 ;;
    esac
done
