#!/usr/bin/env bash
# The demo and the tests as on a machine that has been set up and then cut off: no network, a read-only environment and
# read-only packages, a user without a name and a home, LC_ALL=C. Nothing of the machine is changed: it all happens in
# namespaces of the kernel's, which go with the last process. Linux, where users may make namespaces.
#
#   make setup && bash tests/offline.sh               make demo, then make test
#   bash tests/offline.sh .venv/bin/python -m pytest tests/test_cli.py
set -euo pipefail
cd "$(dirname "$0")/.."
here="$PWD/tests/$(basename "$0")"

case "${OFFLINE_STAGE-}" in
"")
    [ -f .venv/.ready ] || { echo "no environment yet: make setup" >&2; exit 2; }
    room="$(mktemp -d)"
    trap 'rm -rf "$room"' EXIT
    OFFLINE_STAGE=cut TMPDIR="$room" unshare --user --map-root-user --net --mount bash "$here" "$@"
    ;;
cut)
    for folder in .venv lightdepth densify train; do
        mount --bind "$folder" "$folder"
        mount -o remount,bind,ro "$folder"
    done
    # A machine without network still has its own address (127.0.0.1): flags up and running.
    .venv/bin/python -c 'import fcntl, socket, struct
fcntl.ioctl(socket.socket(), 0x8914, struct.pack("16sh", b"lo", 0x41))'
    exec unshare --user --map-user=54321 --map-group=54321 \
        env -i OFFLINE_STAGE=work PATH="$PATH" TMPDIR="$TMPDIR" LC_ALL=C \
        ${LIGHTDEPTH_REALDATA:+LIGHTDEPTH_REALDATA="$LIGHTDEPTH_REALDATA"} \
        ${OMP_NUM_THREADS:+OMP_NUM_THREADS="$OMP_NUM_THREADS"} \
        bash "$here" "$@"
    ;;
work)
    unset OFFLINE_STAGE
    .venv/bin/python - <<'END'
import getpass, os, pathlib, socket, sysconfig
def fails(what, call):
    try:
        call()
    except (OSError, RuntimeError, KeyError):
        return
    raise SystemExit(f"not cut off: {what} works")
fails("the network", lambda: socket.create_connection(("192.0.2.1", 80), 1))
fails("a name server", lambda: socket.getaddrinfo("example.org", 80))
fails("a home", pathlib.Path.home)
fails("the user's name", getpass.getuser)
for folder in (sysconfig.get_path("purelib"), "lightdepth", "densify", "train"):
    fails(f"writing to {folder}", lambda: (pathlib.Path(folder) / "new").touch())
print(f"cut off: uid {os.getuid()}, locale C, no network, no home, packages read-only", flush=True)
END
    if [ $# -gt 0 ]; then
        "$@"
    else
        make demo
        make test
    fi
    ;;
esac
