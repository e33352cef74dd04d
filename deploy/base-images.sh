#!/bin/sh
# Makes the two base images of deploy/Dockerfile from this machine where no image registry can be reached:
# an air-gapped site, or a builder that may only talk to package mirrors. Where a registry answers you do not
# need this: `docker compose build` pulls both.
#
# usage: deploy/base-images.sh            needs: docker, mmdebstrap, a Rust toolchain >= 1.95 on PATH
#
# Idempotent: an image that exists under its usual name is left alone. Nothing is pulled or pushed.
# The host's CA bundle goes into both images: on networks that inspect TLS the crate registry's certificate is
# refused without it.
set -eu

debian_image=debian:bookworm-slim
rust_image=rust:1.95-slim-bookworm
rust_minor_wanted=95
ca_bundle=/etc/ssl/certs/ca-certificates.crt

die() { echo "base-images: $*" >&2; exit 1; }
need() { command -v "$1" >/dev/null 2>&1 || die "$1 is not installed: $2"; }
have_image() { docker image inspect "$1" >/dev/null 2>&1; }

need docker "install docker.io or Docker Engine"
docker version >/dev/null 2>&1 || die "no Docker daemon answers: start it, or join the docker group"

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
trap 'exit 130' INT TERM

if have_image "$debian_image"; then
    echo "$debian_image: already here"
else
    need mmdebstrap "apt-get install mmdebstrap"
    echo "$debian_image: building a minimal Debian bookworm"
    set --
    [ -r "$ca_bundle" ] && set -- "--customize-hook=copy-in $ca_bundle /etc/ssl/certs"
    # To a file, not a pipe: plain sh cannot see a failure on the left of a pipe, and half an image must not be tagged.
    mmdebstrap --quiet --variant=minbase --include=ca-certificates "$@" bookworm "$work/debian.tar" \
        || die "mmdebstrap failed; can this machine reach a Debian mirror?"
    docker import --change 'CMD ["bash"]' "$work/debian.tar" "$debian_image" >/dev/null
    rm -f "$work/debian.tar"
fi

if have_image "$rust_image"; then
    echo "$rust_image: already here"
else
    need rustc "install Rust with rustup, or put a toolchain on PATH"
    minor=$(rustc --version | sed -n 's/^rustc 1\.\([0-9]*\)\..*/\1/p')
    [ "${minor:-0}" -ge "$rust_minor_wanted" ] \
        || die "rustc 1.$rust_minor_wanted or later is needed, this is $(rustc --version)"
    sysroot=$(rustc --print sysroot)
    [ -x "$sysroot/bin/cargo" ] || die "$sysroot holds no cargo: install the cargo component of this toolchain"
    echo "$rust_image: $debian_image + gcc + the toolchain in $sysroot"
    mkdir -p "$work/context/toolchain"
    tar -C "$sysroot" --exclude=./share --exclude=./lib/rustlib/src --exclude='./lib/rustlib/wasm*' -cf - . \
        >"$work/toolchain.tar"
    tar -C "$work/context/toolchain" -xf "$work/toolchain.tar"
    rm -f "$work/toolchain.tar"
    cat >"$work/context/Dockerfile" <<DOCKERFILE
FROM $debian_image
RUN apt-get update \\
    && apt-get install -y --no-install-recommends gcc libc6-dev \\
    && rm -rf /var/lib/apt/lists/*
COPY toolchain /usr/local/rust
ENV CARGO_HOME=/usr/local/cargo PATH=/usr/local/cargo/bin:/usr/local/rust/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
RUN rustc --version && cargo --version
DOCKERFILE
    docker build --tag "$rust_image" "$work/context" >"$work/build.log" 2>&1 \
        || { tail -n 40 "$work/build.log" >&2; die "building $rust_image failed"; }
fi
