#!/usr/bin/env bash
# Build the image and try it: its size and start time; the demo; a flight mounted read-only, under a read-only root, for
# a user that the image does not have; and the cluster of compose.yaml. Prints the seconds of each.
#
#     tools/container.sh [demo options]
#
# With docker where an engine answers. Else by buildah on a debootstrap base (as root; apt-get install buildah
# debootstrap), and what docker's options do is done by hand: a namespace of mounts, a root remounted read-only, another
# user. There all containers share this machine's network, and no limits of memory or of system calls hold.
#
# Leaves the image `agalign` and what it was built from. TORCH_INDEX is PyTorch's index of CPU wheels; in its place
# PIP_FIND_LINKS may name a folder that has the wheel.
set -euo pipefail
cd "$(dirname "$0")/.."

user=12345:12345
folder=$(mktemp -d)
flight=$folder/demo/flight
mkdir "$folder/demo" "$folder/aligned" "$folder/cluster"
chown "$user" "$folder/demo" "$folder/aligned" "$folder/cluster" 2> /dev/null || user=$(id -u):$(id -g)
chmod 755 "$folder"

version=$(sed -n 's/^__version__ = "\(.*\)"/\1/p' agalign/_version.py)
labels=(--build-arg "VERSION=$version" --build-arg "SOURCE=${SOURCE:-}")
if revision=$(git rev-parse HEAD 2> /dev/null); then labels+=(--build-arg "REVISION=$revision"); fi

if docker info > /dev/null 2>&1; then
    trap 'docker compose down > /dev/null 2>&1 || true; rm -rf "$folder"' EXIT

    build() { docker build --quiet "${labels[@]}" --build-arg "TORCH_INDEX=${TORCH_INDEX:-}" -t agalign .; }
    size() { docker image inspect --format '{{.Size}}' agalign; }
    inside() {  # inside FOLDER-TO-READ FOLDER-TO-WRITE PROGRAM [ARGUMENTS]
        docker run --rm --init --read-only --tmpfs /tmp --user "$user" --volume "$1:/data/flight:ro" \
            --volume "$2:/data/aligned" --entrypoint "$3" agalign "${@:4}"
    }
    cluster() {  # cluster FOLDER-TO-READ FOLDER-TO-WRITE [ARGUMENTS]
        FLIGHT=$1 ALIGNED=$2 USER_IDS=$user docker compose run --rm align "${@:3}"
    }
else
    export STORAGE_DRIVER=vfs BUILDAH_ISOLATION=chroot
    suite=bookworm
    root=
    clean_up() {
        for job in $(jobs -p); do kill -KILL -- "-$job" 2> /dev/null || true; done
        wait 2> /dev/null
        if [ -n "$root" ]; then buildah rm agalign-tried > /dev/null; fi
        rm -rf "$folder"
    }
    trap clean_up EXIT

    build() {
        if ! buildah inspect --type image "agalign-base:$suite" > /dev/null 2>&1; then
            debootstrap --variant=minbase "$suite" "$folder/base" > /dev/null
            local base
            base=$(buildah from scratch)
            buildah copy --quiet "$base" "$folder/base" / > /dev/null
            buildah commit --quiet "$base" "agalign-base:$suite" > /dev/null
            buildah rm "$base" > /dev/null
        fi
        # This machine's certificates and folder of wheels serve the build too.
        local mounts=(--volume "$folder/pip.conf:/etc/pip.conf:ro")
        echo "[global]" > "$folder/pip.conf"
        if [ -d "${PIP_FIND_LINKS:-}" ]; then
            echo "find-links = $PIP_FIND_LINKS" >> "$folder/pip.conf"
            mounts+=(--volume "$PIP_FIND_LINKS:$PIP_FIND_LINKS:ro")
        fi
        if [ -n "${SSL_CERT_FILE:-}" ]; then
            echo "cert = /run/certificates.pem" >> "$folder/pip.conf"
            mounts+=(--volume "$SSL_CERT_FILE:/run/certificates.pem:ro")
        fi
        buildah build --quiet --layers "${labels[@]}" "${mounts[@]}" --build-arg "BASE=localhost/agalign-base:$suite" \
            --build-arg "TORCH_INDEX=${TORCH_INDEX:-}" -t agalign . > "$folder/build.log" 2>&1 ||
            { cat "$folder/build.log" >&2; return 1; }
        buildah from --quiet --pull-never --name agalign-tried agalign > /dev/null
        root=$(buildah mount agalign-tried)
        mkdir -p "$root/data/flight" "$root/data/aligned"
        echo "127.0.0.1 localhost scheduler" > "$root/etc/hosts"
    }
    size() { buildah images --format '{{.Size}}' agalign; }
    inside() {
        # shellcheck disable=SC2016
        unshare --mount --pid --fork --kill-child bash -euc '
            root=$0 user=$1
            mount --bind "$root" "$root"
            mount -o remount,bind,ro "$root"
            mount -t proc proc "$root/proc"
            mount --rbind /dev "$root/dev"
            mount -t tmpfs tmpfs "$root/tmp"
            mount --bind "$2" "$root/data/flight"
            mount -o remount,bind,ro "$root/data/flight"
            mount --bind "$3" "$root/data/aligned"
            shift 3
            exec chroot --userspec="$user" "$root" env --ignore-environment --chdir=/data \
                PATH=/opt/venv/bin:/usr/bin:/bin HOME=/tmp PYTHONDONTWRITEBYTECODE=1 "$@"' "$root" "$user" "$@"
    }
    service() {  # service NAME FOLDER-TO-READ FOLDER-TO-WRITE [ARGUMENTS], as compose.yaml says
        local command
        mapfile -t command < <(inside "$2" "$3" python3 -c '
import sys, yaml
print(*yaml.safe_load(sys.stdin)["services"][sys.argv[1]]["entrypoint"], sep="\n")' "$1" < compose.yaml)
        inside "$2" "$3" "${command[@]}" "${@:4}"
    }
    cluster() {
        if (exec 3<> /dev/tcp/127.0.0.1/8786) 2> /dev/null; then
            echo "port 8786 is taken by another scheduler" >&2
            return 1
        fi
        set -m  # each in a process group of its own, by which it is ended
        service scheduler "$1" "$2" 2> "$folder/scheduler.log" &
        until (exec 3<> /dev/tcp/127.0.0.1/8786) 2> /dev/null; do sleep 0.2; done
        service worker "$1" "$2" 2> "$folder/worker-1.log" &
        service worker "$1" "$2" 2> "$folder/worker-2.log" &
        service align "$@"
    }
fi

took() {  # took WHAT COMMAND: its seconds, which go to standard error with its own words
    local TIMEFORMAT="== $1: %R s"
    time "${@:2}"
}

took "build" build
echo "== size: $(size)"
for _ in 1 2 3; do took "start" inside "$folder/demo" "$folder/aligned" agalign --help; done
took "demo" inside "$folder/demo" "$folder/demo" agalign demo /data/aligned "$@"
took "a flight read-only, a root read-only, user $user" \
    inside "$flight" "$folder/aligned" agalign /data/flight -o /data/aligned --quiet
test -s "$folder/aligned/index.html"

if said=$(inside "$flight" "$folder/aligned" agalign /data/flight --quiet 2>&1); then
    echo "an output that cannot be created was not reported" >&2
    exit 1
fi
echo "== without -o: $said"

took "compose.yaml" cluster "$flight" "$folder/cluster" /data/flight -o /data/aligned --quiet
test -s "$folder/cluster/index.html"
for name in $(cd "$folder/aligned" && find . -name '*.tif'); do
    cmp "$folder/aligned/$name" "$folder/cluster/$name"
done
echo "== the cluster's images are those of one container"
