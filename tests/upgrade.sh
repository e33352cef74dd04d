#!/usr/bin/env bash
# Binaries of an earlier commit and those of now meet on loopback (scenario 33). Where both speak one protocol everything works, and
# images are the same bytes; where not, who came last is refused with an error that names both versions. Never a panic, a
# message that does not decode, or a hang.
#
#   BIN=target/debug tests/upgrade.sh [COMMIT]
#
#   COMMIT   whose binaries are the old ones (default: the newest before the protocol version of now)
#   OLD      a folder with its binaries (default: they are built here, in a worktree of its own)
#   PROFILE  what they are built as: dev or release (default dev); CARGO_TARGET_DIR says where, to share dependencies
#   LOGS     an empty folder to keep logs and images in (default: a temporary one, kept after a failure only)
#
# A line for each try. Exit codes: 0 all came out as they should, 1 not so, 2 usage, 77 cannot run here.
set -Eeuo pipefail
trap 'echo "upgrade: broke off at line $LINENO" >&2' ERR
cd "$(dirname "$0")/.."

declare -A bin=([new]=$(realpath "${BIN:-target/debug}")) version=()
profile=${PROFILE:-dev}
# Longest waits, in seconds: past the 30 s for which a coordinator is tried, and far past what a loaded two-core machine needs.
try_patience_s=90
message=farm-core/src/message.rs
work=${LOGS:-$(mktemp -d)}
mkdir -p "$work"
work=$(realpath "$work")
[ -z "$(ls -A "$work")" ] || { echo "upgrade: $work is not empty" >&2; exit 2; }
pids=() faults=0

say() { echo "upgrade: $*"; }
fault() { faults=$((faults + 1)); say "FAULT: $*"; }
cannot() { echo "upgrade: cannot run here: $*" >&2; exit 77; }
clean_up() {
    local code=$?
    for pid in "${pids[@]}"; do kill -9 "$pid" 2>/dev/null || true; done
    [ ! -e "$work/tree" ] || git worktree remove --force "$work/tree"
    if [ "$code" = 0 ] && [ -z "${LOGS:-}" ]; then rm -rf "$work"; else say "logs are in $work"; fi
}
trap clean_up EXIT

protocol_of() { sed -n 's/^pub const PROTOCOL_VERSION: u32 = \([0-9]*\);$/\1/p'; }
version[new]=$(protocol_of <$message)
[ -n "${version[new]}" ] || cannot "no protocol version in $message"
commit=${1:-$(git log --reverse --format=%H -S"PROTOCOL_VERSION: u32 = ${version[new]};" -- $message | head -n 1)~}
commit=$(git rev-parse --quiet --verify --short "$commit^{commit}") || { echo "upgrade: no such commit: $1" >&2; exit 2; }
version[old]=$(git show "$commit:$message" | protocol_of)
say "old is $commit, protocol ${version[old]}; new is protocol ${version[new]}"

if [ -n "${OLD:-}" ]; then
    bin[old]=$(realpath "$OLD")
else
    git worktree add --quiet --detach "$work/tree" "$commit"
    target=${CARGO_TARGET_DIR:-$work/target}
    (cd "$work/tree" && CARGO_TARGET_DIR=$target cargo build --quiet --locked --profile "$profile" --bins \
        -p worker -p coordinator -p farmctl)
    # The next commit's go to the same place.
    mkdir -p "$work/old"
    cp "$target/${profile/#dev/debug}"/{farm-worker,farm-coordinator,farmctl} "$work/old/"
    bin[old]=$work/old
fi
for side in old new; do
    for name in farm-worker farm-coordinator farmctl; do
        [ -x "${bin[$side]}/$name" ] || cannot "no ${bin[$side]}/$name"
    done
done

# ---- Processes

end() { # PID: in order, and its exit code
    kill -TERM "$1" 2>/dev/null || true
    wait "$1"
}
# Starts a daemon, waits until it is ready or has ended, and sets $pid; empty if it has ended, with $code.
start() { # LOG COMMAND...
    local log=$work/$1 deadline=$((SECONDS + try_patience_s))
    shift
    "$@" >"$log.out" 2>"$log.log" &
    pid=$! code=
    pids+=("$pid")
    until [ -s "$log.out" ]; do
        if ! kill -0 "$pid" 2>/dev/null; then code=0; wait "$pid" || code=$?; pid=; return; fi
        [ "$SECONDS" -lt "$deadline" ] || { code=hangs pid=; return; }
        sleep 0.05
    done
}
start_coordinator() { # SIDE LOG STATE [LISTEN]: sets $address
    start "$2" "${bin[$1]}/farm-coordinator" --listen "${4:-127.0.0.1:0}" --http 127.0.0.1:0 --state "$work/state/$3"
    [ -n "$pid" ] || { fault "the $1 coordinator does not start ($code): $(tail -n 1 "$work/$2.log")"; exit 1; }
    address=$(sed -n 's/.*"grpc":"\([^"]*\)".*/\1/p' "$work/$2.out")
}
start_worker() { # SIDE LOG
    start "$2" "${bin[$1]}/farm-worker" --coordinator "$address" --listen 127.0.0.1:0 --name "$2" --device cpu
}
# Runs farmctl to its end; its exit code is in $code.
farmctl() { # SIDE LOG WORDS...
    local side=$1 log=$work/$2
    shift 2
    code=0
    timeout "$try_patience_s" "${bin[$side]}/farmctl" --coordinator "$address" "$@" >"$log.out" 2>"$log.log" || code=$?
    [ "$code" != 124 ] || code=hangs
}

# ---- What has to become of a try

words() { tail -n 1 "$work/$1.log" | cut -c 1-300; }
# In order: it works.
works() { # WHAT LOG
    if [ "${code:-0}" = 0 ]; then say "$1: works"; else fault "$1: $code: $(words "$2")"; fi
}
# A peer of another version: refused, both versions named, by a process that ends.
refused() { # WHAT LOG
    local said
    said=$(words "$2")
    if [ "${code:-0}" = 0 ] || [ "$code" = hangs ]; then
        fault "$1: not refused (${code:-it runs}): $said"
    elif [[ $said == *"version ${version[old]} "* && $said == *"version ${version[new]} "* ]]; then
        say "$1: refused, exit $code: $said"
    else
        fault "$1: refused without both versions, exit $code: $said"
    fi
}
# Sessions need one protocol.
same() { [ "${version[old]}" = "${version[new]}" ]; }
judge() { if same; then works "$@"; else refused "$@"; fi; }
# Requests of operators do not: fields that a peer does not know are passed over, and a request that it does not know is refused.
requests() { # SIDE OF
    local request log
    for request in status "cache ls" "timeline @all" "project set upgrade --devices 1"; do
        log=$1-farmctl-${request%% *}-at-$2
        # shellcheck disable=SC2086 # a verb and its words
        if "${bin[old]}/farmctl" $request --help >/dev/null 2>&1; then
            [[ $request != project* ]] || continue # wants a secured farm
            farmctl "$1" "$log" -o json $request
            works "$1 farmctl $request, $2 coordinator" "$log"
        elif [ "$1" = new ]; then
            farmctl "$1" "$log" -o json $request
            if [ "$code" = 1 ] && [[ $(words "$log") == *"earlier version"* ]]; then
                say "$1 farmctl $request, $2 coordinator: refused, exit $code: $(words "$log")"
            else
                fault "$1 farmctl $request, $2 coordinator: $code: $(words "$log")"
            fi
        fi
    done
}
render() { # SIDE IMAGE
    farmctl "$1" "render-$2" render "$work/scene" -o "$work/$2.exr" --size 64x64 --spp 2 --seed 7
}
same_bytes() { # IMAGE IMAGE
    if cmp "$work/$1.exr" "$work/$2.exr"; then say "$1 and $2: the same bytes"; else fault "$1 and $2 differ"; fi
}

"${bin[new]}/farmctl" scene cornell-box "$work/scene" >/dev/null

# ---- A farm of each side, with its own worker, and who comes to it from the other side.

declare -A other=([old]=new [new]=old)
for side in new old; do
    guest=${other[$side]}
    start_coordinator $side "$side-coordinator" "$side"
    coordinator=$pid
    start_worker $side "$side-worker"
    worker=$pid
    works "$side worker, $side coordinator" "$side-worker"
    render $side "$side-image"
    works "$side render, $side farm" "render-$side-image"
    requests "$guest" $side

    start_worker "$guest" "$guest-worker-at-$side"
    guest_worker=$pid
    judge "$guest worker, $side coordinator" "$guest-worker-at-$side"
    render "$guest" "$guest-image-at-$side"
    judge "$guest render, $side farm" "render-$guest-image-at-$side"
    if [ -n "$guest_worker" ]; then
        end "$worker" || fault "the $side worker was drained and ended with $?"
        worker=$guest_worker
    fi
    # None the worse for it; or, all jobs are the guest's: an application of one side, a node of the other.
    render $side "$side-image-after"
    works "$side render with the ${guest_worker:+$guest }worker" "render-$side-image-after"
    same_bytes "$side-image" "$side-image-after"
    end "$worker" || fault "the worker of the $side farm was drained and ended with $?"
    end "$coordinator" || fault "the $side coordinator was ended and exits with $?"
done
if same; then
    for side in old new; do same_bytes "$side-image" "$side-image-at-${other[$side]}"; done
fi

# ---- The coordinator is upgraded, on its port and its state folder, under a worker and an application that stay old. A new
# application never speaks to an old node otherwise: who has both for members is a coordinator that has refused one of them.

long_render() { # SIDE IMAGE
    "${bin[$1]}/farmctl" --coordinator "$address" render "$work/scene" -o "$work/$2.exr" --size 64x64 --spp 256 --seed 7 \
        --progress ndjson >"$work/render-$2.out" 2>"$work/render-$2.log" &
    pid=$!
    pids+=("$pid")
}
await() { # PID: its exit code is in $code
    local deadline=$((SECONDS + try_patience_s))
    while kill -0 "$1" 2>/dev/null && [ "$SECONDS" -lt "$deadline" ]; do sleep 0.05; done
    code=0
    if kill -0 "$1" 2>/dev/null; then code=hangs; else wait "$1" || code=$?; fi
}
start_coordinator old coordinator-before upgraded
coordinator=$pid
start_worker old worker-that-stays
worker=$pid
long_render old old-image-of-the-upgrade
render=$pid
until grep -qs '"jobs_done":[1-9]' "$work/render-old-image-of-the-upgrade.out"; do
    kill -0 "$render" 2>/dev/null || { fault "the old render is over before it began: $(words render-old-image-of-the-upgrade)"; exit 1; }
    sleep 0.05
done
end "$coordinator" || fault "the old coordinator was ended and exits with $?"
start_coordinator new coordinator-after upgraded "$address"
await "$render"
judge "old render under way while the coordinator is upgraded" render-old-image-of-the-upgrade
if same; then
    long_render old old-image-undisturbed
    await "$pid"
    works "old render after that, jobs on the old worker that stayed" render-old-image-undisturbed
    same_bytes old-image-of-the-upgrade old-image-undisturbed
    end "$worker" || fault "the worker that stayed was drained and ended with $?"
else
    await "$worker"
    refused "old worker that stayed while the coordinator was upgraded" worker-that-stays
fi

for log in "$work"/*.log; do
    ! grep -H -i -m 1 -E 'panicked at|decod|malformed' "$log" || fault "see $(basename "$log")"
done
[ "$faults" = 0 ] || { say "$faults faults"; exit 1; }
say "all as it should be"
