#!/usr/bin/env bash
# Build the image and run the demo in it, with docker where an engine answers, else with buildah on a debootstrap base
# (as root; apt-get install buildah debootstrap). Leaves nothing behind but the image `agalign`.
#
#     tools/container.sh [demo options]
set -euo pipefail
cd "$(dirname "$0")/.."

if docker info > /dev/null 2>&1; then
    docker build -t agalign .
    docker run --rm --workdir /tmp agalign demo /tmp/agalign-demo "$@"
    exit
fi

export STORAGE_DRIVER=vfs BUILDAH_ISOLATION=chroot
suite=bookworm
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
if ! buildah inspect --type image "agalign-base:$suite" > /dev/null 2>&1; then
    debootstrap --variant=minbase "$suite" "$root/$suite"
    base=$(buildah from scratch)
    buildah copy --quiet "$base" "$root/$suite" / > /dev/null
    buildah commit --quiet "$base" "agalign-base:$suite" > /dev/null
    buildah rm "$base" > /dev/null
fi

# The host's Python package sources and certificate, so that a mirror or proxy set up here serves the build too. Further
# folders that those sources refer to can be named in EXTRA_MOUNTS, separated by spaces.
mounts=()
for path in ${PIP_FIND_LINKS:-} ${EXTRA_MOUNTS:-}; do
    if [ -e "$path" ]; then mounts+=(--volume "$path:$path:ro"); fi
done
touch "$root/pip.conf"
if [ -e /etc/pip.conf ]; then cp /etc/pip.conf "$root/pip.conf"; fi
if [ -n "${SSL_CERT_FILE:-}" ]; then
    sed -i "s|^cert *=.*|cert = /run/host-certificates.pem|" "$root/pip.conf"
    mounts+=(--volume "$SSL_CERT_FILE:/run/host-certificates.pem:ro")
fi
mounts+=(--volume "$root/pip.conf:/etc/pip.conf:ro")
buildah build --quiet "${mounts[@]}" --build-arg "BASE=localhost/agalign-base:$suite" -t agalign . > /dev/null
container=$(buildah from --pull-never agalign)
trap 'buildah rm "$container" > /dev/null; rm -rf "$root"' EXIT
buildah run --user agalign --workingdir /tmp "$container" -- agalign demo /tmp/agalign-demo "$@"
