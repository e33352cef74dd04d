#!/usr/bin/env bash
# Installs what a new Debian or Ubuntu machine lacks to build Gleaner and to run it without a GPU. Idempotent.
# A Rust toolchain (1.95 or newer) is the one thing it asks for instead of installing.
set -euo pipefail

if ! command -v cargo >/dev/null 2>&1; then
    echo "setup: no cargo found: install Rust 1.95 or newer (https://rustup.rs), then run this again" >&2
    exit 1
fi

packages=()
command -v cc >/dev/null 2>&1 || packages+=(gcc libc6-dev)
ldconfig -p 2>/dev/null | grep -q 'libvulkan\.so\.1' || packages+=(libvulkan1)
# Any Vulkan driver will do; Mesa brings lavapipe (Vulkan on the CPU) and those of AMD and Intel GPUs.
compgen -G '/usr/share/vulkan/icd.d/lvp_icd*.json' >/dev/null || packages+=(mesa-vulkan-drivers)
if [ "${1:-}" = test ]; then
    command -v python3 >/dev/null 2>&1 || packages+=(python3)
    # The compose test makes its base images where a Docker daemon has none and no registry gives them.
    ! command -v docker >/dev/null 2>&1 || command -v mmdebstrap >/dev/null 2>&1 || packages+=(mmdebstrap)
fi

if [ ${#packages[@]} -gt 0 ]; then
    if ! command -v apt-get >/dev/null 2>&1; then
        echo "setup: please install the equivalents of these Debian packages: ${packages[*]}" >&2
        exit 1
    fi
    as_root=()
    [ "$(id -u)" = 0 ] || as_root=(sudo)
    echo "setup: installing ${packages[*]}" >&2
    "${as_root[@]}" apt-get update -q
    DEBIAN_FRONTEND=noninteractive "${as_root[@]}" apt-get install -qy --no-install-recommends "${packages[@]}"
fi

# The test runner: one process per test, so that a driver's abort is one failed test.
if [ "${1:-}" = test ] && ! cargo nextest --version >/dev/null 2>&1; then
    echo "setup: installing cargo-nextest" >&2
    cargo install --locked cargo-nextest
fi
