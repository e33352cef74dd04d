#!/usr/bin/env bash
# The farm of compose.yaml, used from the host: up, render through it, kill a worker's container in mid-render, compare with the
# undisturbed image byte for byte, down. Says "skipped: REASON" and succeeds where no Docker daemon answers.
#
#   FARMCTL=path        the host's farmctl (default: target/release/farmctl, else target/debug/farmctl)
#   GLEANER_*_PORT      ports on 127.0.0.1 (GRPC, HTTP, WORKER_1, WORKER_2, WORKER_3; default: free ones)
#
# The project has a name of its own and is taken down with its volumes whatever happens; the image gleaner:local stays, as the
# next build's cache.
set -euo pipefail
cd "$(dirname "$0")/.."

# Longest waits, in seconds: far past what a loaded two-core machine needs.
health_patience_s=180
progress_patience_s=240
render_patience_s=600
# Enough jobs that a worker can be killed between them.
render_flags=(--size 160x128 --spp 32 --seed 1)

say() { echo "compose: $*"; }
fail() { echo "compose: FAILED: $*" >&2; exit 1; }
skip() { echo "skipped: $*"; exit 0; }

command -v docker >/dev/null 2>&1 || skip "docker is not installed"
daemon=$(timeout 30 docker version --format '{{.Server.Version}}' 2>&1) || skip "no Docker daemon answers: ${daemon##*$'\n'}"
if docker compose version >/dev/null 2>&1; then
    compose=(docker compose)
elif command -v docker-compose >/dev/null 2>&1; then
    compose=(docker-compose)
else
    skip "neither \"docker compose\" nor docker-compose is installed"
fi

farmctl=${FARMCTL:-}
for candidate in target/release/farmctl target/debug/farmctl; do
    [ -n "$farmctl" ] || [ ! -x "$candidate" ] || farmctl=$candidate
done
[ -n "$farmctl" ] && [ -x "$farmctl" ] || fail "no farmctl on the host: cargo build --release, or set FARMCTL"

# A free port below the ephemeral range; those already given out here are not free.
taken=()
free_port() {
    local port hex
    for _ in $(seq 200); do
        port=$((20000 + RANDOM % 12000))
        hex=$(printf ':%04X ' "$port")
        grep -q "$hex" /proc/net/tcp /proc/net/udp /proc/net/tcp6 /proc/net/udp6 2>/dev/null && continue
        case " ${taken[*]:-} " in *" $port "*) continue ;; esac
        taken+=("$port")
        free=$port
        return
    done
    fail "no free port found in 200 tries"
}
for name in GRPC HTTP WORKER_1 WORKER_2 WORKER_3; do
    variable=GLEANER_${name}_PORT
    if [ -z "${!variable:-}" ]; then
        free_port
        export "$variable=$free"
    fi
done
coordinator=127.0.0.1:$GLEANER_GRPC_PORT
unset GLEANER_COORDINATOR

export COMPOSE_PROJECT_NAME="gleaner-test-$$"
work=$(mktemp -d)
render_pid=
cleanup() {
    status=$?
    trap - EXIT INT TERM
    [ -z "$render_pid" ] || kill "$render_pid" 2>/dev/null || true
    if [ "$status" != 0 ]; then
        "${compose[@]}" ps >&2 || true
        "${compose[@]}" logs --no-color --tail 40 >&2 || true
    fi
    "${compose[@]}" down --volumes --timeout 5 >"$work/down.log" 2>&1 || { cat "$work/down.log" >&2; status=1; }
    rm -rf "$work"
    exit "$status"
}
trap cleanup EXIT
trap 'exit 130' INT TERM

# Base images: here, from the registry, or made on this machine.
for image in debian:bookworm-slim rust:1.95-slim-bookworm; do
    docker image inspect "$image" >/dev/null 2>&1 && continue
    timeout 300 docker pull --quiet "$image" >/dev/null 2>&1 || { deploy/base-images.sh; break; }
done

say "building the image"
"${compose[@]}" build coordinator >"$work/build.log" 2>&1 || { tail -n 60 "$work/build.log" >&2; fail "the image does not build"; }

say "up: coordinator on $coordinator, three workers"
"${compose[@]}" up -d >"$work/up.log" 2>&1 || { cat "$work/up.log" >&2; fail "the farm does not come up"; }

container() { "${compose[@]}" ps -q "$1"; }
health() { docker inspect --format '{{.State.Health.Status}}' "$(container "$1")" 2>/dev/null || true; }
deadline=$((SECONDS + health_patience_s))
for service in coordinator worker-1 worker-2 worker-3; do
    until [ "$(health "$service")" = healthy ]; do
        [ "$SECONDS" -lt "$deadline" ] || fail "$service is $(health "$service") after $health_patience_s s"
        sleep 0.5
    done
done
say "healthy"

"$farmctl" scene cornell-box "$work/cornell" >/dev/null
render() { timeout "$render_patience_s" "$farmctl" --coordinator "$coordinator" render "$work/cornell" -o "$1" "${render_flags[@]}" "${@:2}"; }

render "$work/quiet.exr" --progress none || fail "the undisturbed render failed"
say "undisturbed image: $(wc -c <"$work/quiet.exr") bytes"

# The number of jobs done by the last line of progress.
jobs_done() { sed -n 's/.*"jobs_done":\([0-9]*\).*/\1/p' "$work/progress" | tail -n 1; }

render "$work/disturbed.exr" --progress ndjson >"$work/progress" 2>"$work/render.log" &
render_pid=$!
deadline=$((SECONDS + progress_patience_s))
until done_before=$(jobs_done) && [ "${done_before:-0}" -ge 2 ]; do
    kill -0 "$render_pid" 2>/dev/null || { cat "$work/render.log" >&2; fail "the render ended before a worker could be killed"; }
    [ "$SECONDS" -lt "$deadline" ] || fail "no two jobs done in $progress_patience_s s"
    sleep 0.05
done
killed=$(container worker-2)
docker kill --signal KILL "$killed" >/dev/null
kill -0 "$render_pid" 2>/dev/null || fail "the render ended while the worker was killed: make it longer"
say "killed worker-2 after $done_before jobs"
wait "$render_pid" || { render_pid=; cat "$work/render.log" >&2; fail "the disturbed render failed"; }
render_pid=
[ "$(docker inspect --format '{{.State.Running}}' "$killed")" = false ] || fail "the killed container runs"
replanned=$(sed -n 's/.*"replanned":\([0-9]*\).*/\1/p' "$work/progress" | tail -n 1)
say "all $(jobs_done) jobs done, ${replanned:-0} planned again"

cmp "$work/quiet.exr" "$work/disturbed.exr" || fail "the images differ"
# Negative control: a comparison that cannot fail proves nothing.
render_flags=(--size 160x128 --spp 1 --seed 2)
render "$work/other.exr" --progress none || fail "the control render failed"
! cmp -s "$work/quiet.exr" "$work/other.exr" || fail "another seed gave the same bytes"
say "byte-identical"
