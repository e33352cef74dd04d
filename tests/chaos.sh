#!/usr/bin/env bash
# A render during minutes of kills and partitions is byte-identical to the undisturbed one (issue 6). Coordinator, workers on
# lavapipe and the application (farmctl) are network namespaces on one bridge; a seeded script of trouble runs beside the render.
# Needs root, iproute2, nftables, python3 and binaries; touches nothing outside its own namespaces.
#
#   BIN=target/release tests/chaos.sh [SCENE]
#
#   SCENE                 a scene folder; without it the Cornell box that farmctl writes
#   SEED                  of the trouble (default 1): what is done to whom, when and for how long depends on it, WORKERS and
#                         KINDS, and on nothing that happens
#   SECONDS_OF_TROUBLE    default 300
#   WORKERS               default 3
#   SIZE, RENDER_SEED     of the image (default 256x192, 1)
#   SPP                   samples per pixel (default: measured, so that an undisturbed render lasts as long as the trouble)
#   KINDS                 the kinds of deeds to draw from (default: all; `KINDS=help` names them)
#   LOGS                  a folder to keep logs and images in (default: a temporary one, kept after a failure only)
#   PLAN=1                only print the deeds of SEED
#   SELFTEST=1            the undisturbed render takes another seed, and the comparison must say so
#
# A disturbed render that ends before the trouble is followed by one of the next render seed; each is compared. Exit codes: 0 all
# identical and the farm whole again, 1 not so (images, a hang, a panic, a daemon that ended by itself, a node that stayed
# away), 2 usage, 77 cannot run here.
set -Eeuo pipefail
trap 'echo "chaos: broke off at line $LINENO" >&2' ERR
cd "$(dirname "$0")/.."

bin=${BIN:-target/debug}
scene=${1:-}
seed=${SEED:-1}
trouble_s=${SECONDS_OF_TROUBLE:-300}
workers=${WORKERS:-3}
size=${SIZE:-256x192}
render_seed=${RENDER_SEED:-1}
spp=${SPP:-}
all_kinds=(kill-worker kill-executor stop-worker kill-coordinator link-down cut-to-coordinator cut-from-coordinator
    cut-application cut-neighbour loss drain)
read -ra kinds <<<"${KINDS:-${all_kinds[*]}}"

# Milliseconds between two deeds, and how long one lasts: past the 3 s after which silence is suspect, and past the 10 s after
# which it is death.
least_pause_ms=5000 most_pause_ms=20000
least_stop_ms=2000 most_stop_ms=15000
# The application tries a lost coordinator for 10 minutes.
least_coordinator_ms=1000 most_coordinator_ms=8000
least_restart_ms=2000 most_restart_ms=6000
least_loss_percent=5 most_loss_percent=40
# Longest waits, in seconds: far past what a loaded two-core machine needs.
ready_patience_s=90
heal_patience_s=90
stall_patience_s=180
most_false_starts=10

say() { echo "chaos: $*"; }
cannot() { echo "chaos: cannot run here: $*" >&2; exit 77; }
usage() { echo "chaos: $*" >&2; exit 2; }

for number in "$seed" "$trouble_s" "$workers" "$render_seed" ${spp:+"$spp"}; do
    [[ $number =~ ^[0-9]{1,9}$ ]] || usage "not a number: \"$number\""
done
[ "$workers" -ge 1 ] && [ "$workers" -le 100 ] || usage "1 to 100 workers, not $workers"
for kind in "${kinds[@]}"; do
    [[ " ${all_kinds[*]} " == *" $kind "* ]] || usage "no kind \"$kind\": ${all_kinds[*]}"
done

# ---- The seeded choices: a generator of our own (Lehmer, modulus 2^31 - 1), so that no other bash draws otherwise.

rng=$((seed % 2147483646 + 1))
draw() { # FIRST LAST: a number of that range, in $drawn
    rng=$((rng * 48271 % 2147483647))
    drawn=$(($1 + (rng >> 4) % ($2 - $1 + 1)))
}
for _ in 1 2 3 4; do draw 0 1; done # small seeds begin alike

bag=()
deed_at_ms=0
# The next deed in deed_at_ms, deed, deed_node, deed_ms, deed_other, deed_percent. Every kind comes before one comes again. What is
# drawn does not depend on the kind, nor on what became of earlier deeds.
next_deed() {
    local pick share
    [ ${#bag[@]} -gt 0 ] || bag=("${kinds[@]}")
    draw "$least_pause_ms" "$most_pause_ms"; deed_at_ms=$((deed_at_ms + drawn))
    draw 0 $((${#bag[@]} - 1)); pick=$drawn
    deed=${bag[pick]}
    unset "bag[pick]"; bag=("${bag[@]}")
    draw 1 "$workers"; deed_node=$drawn
    draw 0 1000; share=$drawn
    draw 0 $((workers > 1 ? workers - 2 : 0)); deed_other=$(((deed_node + drawn) % workers + 1))
    draw "$least_loss_percent" "$most_loss_percent"; deed_percent=$drawn
    case $deed in
        kill-worker | drain) deed_ms=$((least_restart_ms + share * (most_restart_ms - least_restart_ms) / 1000)) ;;
        kill-coordinator) deed_ms=$((least_coordinator_ms + share * (most_coordinator_ms - least_coordinator_ms) / 1000)) ;;
        *) deed_ms=$((least_stop_ms + share * (most_stop_ms - least_stop_ms) / 1000)) ;;
    esac
}

seconds() { printf -v in_seconds '%d.%01d' $(($1 / 1000)) $(($1 % 1000 / 100)); } # MILLISECONDS, into $in_seconds
describe() { # the deed, for people, in $described
    seconds "$deed_ms"
    case $deed in
        kill-worker) described="node-$deed_node, again after $in_seconds s" ;;
        kill-executor) described="node-$deed_node" ;;
        kill-coordinator) described="again after $in_seconds s" ;;
        drain) described="node-$deed_node, another after $in_seconds s" ;;
        cut-neighbour) described="node-$deed_node and node-$deed_other, for $in_seconds s" ;;
        loss) described="node-$deed_node, $deed_percent % both ways, for $in_seconds s" ;;
        *) described="node-$deed_node, for $in_seconds s" ;;
    esac
}

if [ -n "${PLAN:-}" ]; then
    while next_deed; [ "$deed_at_ms" -lt $((trouble_s * 1000)) ]; do
        describe; seconds "$deed_at_ms"
        printf '%7s s  %-20s %s\n' "$in_seconds" "$deed" "$described"
    done
    exit 0
fi

# ---- Can it run here?

[ "$(id -u)" = 0 ] || cannot "not root: namespaces need it"
missing=()
for tool in ip:iproute2 nft:nftables python3:python3; do
    command -v "${tool%:*}" >/dev/null 2>&1 || missing+=("${tool#*:}")
done
# As deploy/setup.sh asks: the device of the workers.
compgen -G '/usr/share/vulkan/icd.d/lvp_icd*.json' >/dev/null || missing+=(mesa-vulkan-drivers)
[ ${#missing[@]} = 0 ] || cannot "please install these Debian packages: ${missing[*]}"
for program in farmctl farm-coordinator farm-worker; do
    [ -x "$bin/$program" ] || cannot "no $bin/$program: cargo build --bins, or set BIN"
done
bin=$(realpath "$bin")
[ -z "$scene" ] || [ -e "$scene" ] || usage "no scene at $scene"
[ -z "$scene" ] || scene=$(realpath "$scene")

net=10.71.8
prefix=glchaos$$
failures=()
render_pid=
coordinator_pid=
declare -A worker_pid worker_name worker_life exit_code
departing=() # "PID NAME" of draining workers
[ -z "${LOGS:-}" ] || [ ! -e "$LOGS" ] || [ -z "$(ls -A "$LOGS")" ] || usage "$LOGS is not empty"
work=${LOGS:-$(mktemp -d)}
mkdir -p "$work/home"
work=$(realpath "$work")
# Nobody's identity, settings or farm but ours.
unset "${!GLEANER_@}"
export HOME=$work/home XDG_RUNTIME_DIR=$work/home NO_COLOR=1

ns() { echo "$prefix-$1"; }
# Not for what runs in the background: the process id would be a shell's.
inside() { local host=$1; shift; ip netns exec "$(ns "$host")" "$@"; }
# What still runs in the namespaces is ours: daemons, executors, farmctl. Quiet: the shell has a word for each that was killed.
end_all() {
    local host pid
    for host in app coordinator $(seq "$workers"); do
        for pid in $(ip netns pids "$(ns "$host")"); do kill -9 "$pid" || true; done
    done
    wait || true
    render_pid='' coordinator_pid=''
} 2>/dev/null
clean_up() {
    local status=$? host
    trap - EXIT INT TERM
    end_all
    for host in app coordinator $(seq "$workers") bridge; do ip netns delete "$(ns "$host")" 2>/dev/null || true; done
    rm -rf "${work:?}/home"
    if [ "$status" = 0 ] && [ -z "${LOGS:-}" ]; then rm -rf "$work"; else echo "chaos: logs in $work" >&2; fi
    exit "$status"
}
trap clean_up EXIT
trap 'exit 130' INT TERM

fail() { echo "chaos: FAILED: $*" >&2; exit 1; }
# A fault that does not end the run, but its success.
fault() { failures+=("$*"); say "FAULT: $*"; }

# ---- The hosts: the bridge has a namespace, too, so that cuts and losses are made where no host sees them.

ip netns add "$(ns bridge)" || cannot "no network namespaces"
ip -n "$(ns bridge)" link add bridge type bridge || cannot "no bridges"
ip -n "$(ns bridge)" link set bridge up
inside bridge nft add table bridge probe || cannot "nftables without bridge filters"
inside bridge nft delete table bridge probe
host() { # NAME ADDRESS
    ip netns add "$(ns "$1")"
    ip -n "$(ns bridge)" link add "port$1" type veth peer name eth0 netns "$(ns "$1")"
    ip -n "$(ns bridge)" link set "port$1" master bridge up
    ip -n "$(ns "$1")" addr add "$2/24" dev eth0
    ip -n "$(ns "$1")" link set lo up
    ip -n "$(ns "$1")" link set eth0 up
}
coordinator=$net.254 application=$net.253
host coordinator "$coordinator"
host app "$application"
for node in $(seq "$workers"); do host "$node" "$net.$node"; done

cuts=0
# Drops what goes from ADDRESS to ADDRESS, both ways if asked, or PERCENT of it. Gives $cut, for heal.
drop() { # FROM|any TO|any [both] [PERCENT]
    local rules=("$1 $2") rule match
    [[ " $* " != *" both "* ]] || rules+=("$2 $1")
    cuts=$((cuts + 1)); cut=cut$cuts
    inside bridge nft add table bridge "$cut"
    inside bridge nft add chain bridge "$cut" forward '{ type filter hook forward priority 0; }'
    for rule in "${rules[@]}"; do
        match=()
        [ "${rule% *}" = any ] || match+=(ip saddr "${rule% *}")
        [ "${rule#* }" = any ] || match+=(ip daddr "${rule#* }")
        [ -z "${4:-}" ] || match+=(numgen random mod 100 '<' "$4")
        inside bridge nft add rule bridge "$cut" forward "${match[@]}" drop
    done
}
heal() { inside bridge nft delete table bridge "$1"; }

# ---- The farm. A "life" of a farm has a state folder and caches of its own; its daemons outlast their processes.

now() { now_ms=$((${EPOCHREALTIME/[.,]/} / 1000)); }
wait_ready() { # FILE PID
    local deadline=$((SECONDS + ready_patience_s))
    until [ -s "$1" ]; do
        kill -0 "$2" 2>/dev/null || fail "it ended before it was ready: see ${1%.out}.log"
        [ "$SECONDS" -lt "$deadline" ] || fail "nothing ready in $1 after $ready_patience_s s"
        sleep 0.1
    done
}
start_coordinator() {
    [ -z "$coordinator_pid" ] || return 0
    ip netns exec "$(ns coordinator)" "$bin/farm-coordinator" --listen "$coordinator:4100" --http 127.0.0.1:4101 --state "$work/$life-state" \
        >"$work/$life-coordinator.out" 2>>"$work/$life-coordinator.log" &
    coordinator_pid=$!
}
start_worker() { # NODE
    [ -z "${worker_pid[$1]:-}" ] || return 0
    local name=${worker_name[$1]}
    : >"$work/$life-$name.out"
    ip netns exec "$(ns "$1")" "$bin/farm-worker" --coordinator "$coordinator:4100" --connect-timeout 5m \
        --listen "$net.$1:0" --name "$name" --device cpu --cache "$work/$life-$name-cache" \
        >"$work/$life-$name.out" 2>>"$work/$life-$name.log" &
    worker_pid[$1]=$!
}
start_farm() { # LIFE
    local node
    life=$1
    start_coordinator
    wait_ready "$work/$life-coordinator.out" "$coordinator_pid"
    for node in $(seq "$workers"); do
        worker_name[$node]=node-$node worker_life[$node]=1 worker_pid[$node]=''
        start_worker "$node"
    done
    for node in $(seq "$workers"); do wait_ready "$work/$life-node-$node.out" "${worker_pid[$node]}"; done
}
farmctl() { inside coordinator timeout 10 "$bin/farmctl" --coordinator "$coordinator:4100" "$@"; }

# Counters are the coordinator's, and begin anew with it: added up over its lives.
declare -A counted=([delivered]=0 [replanned]=0 [stolen]=0 [speculations]=0)
count_status() { # FILE
    local name value
    for name in delivered replanned stolen speculations; do
        value=$(sed -n "s/^  \"$name\(_jobs\)\{0,1\}\": \([0-9]*\).*/\2/p" "$1")
        counted[$name]=$((counted[$name] + ${value:-0}))
    done
}
# What is not yet as it was before the trouble, in lines; nothing when all is.
unwell() { # FILE NAME...
    python3 - "$@" <<'PYTHON'
import json, sys

status = json.load(open(sys.argv[1]))
nodes = {node["name"]: node for node in status["nodes"]}
for name in sys.argv[2:]:
    node = nodes.pop(name, None)
    if node is None or node["state"] != "alive":
        print(f"{name} is {node['state'] if node else 'not there'}")
    elif not node["devices"]:
        print(f"{name} has no device")
    elif any(device["planned_jobs"] or device["running_jobs"] for device in node["devices"]):
        print(f"{name} is said to have jobs: {node['devices']}")
for name, node in nodes.items():
    print(f"{name} is still listed as {node['state']}")
for app in status["apps"]:
    print(f"application {app['app']} is still listed with {app['outstanding_jobs']} jobs")
PYTHON
}

# ---- Renders

start_render() { # NAME SEED SPP
    ip netns exec "$(ns app)" "$bin/farmctl" --coordinator "$coordinator:4100" render "$scene" -o "$work/$1.exr" \
        --size "$size" --spp "$3" --seed "$2" --progress ndjson >"$work/$1.ndjson" 2>"$work/$1.log" &
    render_pid=$!
}
end_render() { # NAME: waits, and fails with what it said
    local code=0
    wait "$render_pid" || code=$?
    render_pid=
    [ "$code" = 0 ] || fail "render $1 ended with $code: $(tail -n 3 "$work/$1.log")"
}
render() { start_render "$@"; end_render "$1"; }
figure() { # NAME KEY: of the last line
    tail -n 1 "$work/$1.ndjson" | sed -n "s/.*\"$2\":\([0-9.]*\).*/\1/p"
}
# Nothing before the render has said something.
jobs_done() { { tail -n 2 "$work/$1.ndjson" | sed -n 's/.*"jobs_done":\([0-9]*\).*/\1/p' | tail -n 1; } 2>/dev/null || true; }

if [ -z "$scene" ]; then
    scene=$work/scene
    "$bin/farmctl" scene cornell-box "$scene" >/dev/null
fi
say "trouble seed $seed, $trouble_s s, $workers workers, scene $scene, $size"
start_farm disturbed
# Negative control of the comparison, and a warm farm.
render same "$render_seed" 1
render again "$render_seed" 1
render other $((render_seed + 1)) 1
cmp "$work/same.exr" "$work/again.exr" || fail "the same seed gave other bytes without any trouble"
! cmp -s "$work/same.exr" "$work/other.exr" || fail "control: another seed gave the same bytes"
if [ -z "$spp" ]; then
    spp=2
    render measure "$render_seed" "$spp"
    # 10 s are enough to tell, beside what a render costs at its start and end.
    while spent=$(figure measure render_seconds); [ "${spent%.*}" -lt 10 ]; do
        spp=$((spp * 2))
        render measure "$render_seed" "$spp"
    done
    spp=$(awk -v spp="$spp" -v spent="$spent" -v wanted="$trouble_s" 'BEGIN { print int(spp * wanted / spent) + 1 }')
    say "an undisturbed render should last $trouble_s s with $spp spp"
fi

# ---- The trouble

executor_of() { # NODE PID: the worker's child, in $executor; empty without one
    local pid
    executor=
    for pid in $(ip netns pids "$(ns "$1")"); do
        [ "$(sed -n 's/^PPid:[[:space:]]*//p' "/proc/$pid/status" 2>/dev/null)" != "$2" ] || executor=$pid
    done
}
# An end that we made: reaped without a word by the shell.
reap() { exit_code[$1]=0; wait "$1" 2>/dev/null || exit_code[$1]=$?; }

undo_at_ms=() undo=()
later() { undo_at_ms+=("$(($1 + deed_at_ms))"); undo+=("$2"); }
declare -A deeds=()
skipped=0 false_starts=0
skip() { skipped=$((skipped + 1)); outcome=" (not done: $*)"; }
# Does the deed. Whatever it does not find it leaves undone, and says so in $outcome.
act() {
    local node=$deed_node pid=${worker_pid[$deed_node]}
    outcome=
    case $deed in
        kill-worker)
            [ -n "$pid" ] || { skip "it is down"; return; }
            kill -9 "$pid"; reap "$pid"; worker_pid[$node]=
            later "$deed_ms" "start_worker $node" ;;
        drain)
            [ -n "$pid" ] || { skip "it is down"; return; }
            kill -TERM "$pid"
            departing+=("$pid ${worker_name[$node]}")
            worker_pid[$node]='' worker_life[$node]=$((worker_life[$node] + 1))
            worker_name[$node]=node-$node-${worker_life[$node]}
            later "$deed_ms" "start_worker $node" ;;
        kill-executor)
            [ -n "$pid" ] || { skip "its worker is down"; return; }
            executor_of "$node" "$pid"
            [ -n "$executor" ] || { skip "there is none"; return; }
            # A worker whose device does not open at its start ends, as it should.
            [ -s "$work/$life-${worker_name[$node]}.out" ] || { skip "its worker is still starting"; return; }
            kill -9 "$executor" 2>/dev/null || { skip "it has just ended"; return; } ;;
        stop-worker)
            [ -n "$pid" ] || { skip "it is down"; return; }
            kill -STOP "$pid"
            later "$deed_ms" "go_on $pid" ;;
        kill-coordinator)
            [ -n "$coordinator_pid" ] || { skip "it is down"; return; }
            take_count
            kill -9 "$coordinator_pid"; reap "$coordinator_pid"; coordinator_pid=
            later "$deed_ms" start_coordinator ;;
        link-down)
            ip -n "$(ns "$node")" link set eth0 down
            later "$deed_ms" "ip -n $(ns "$node") link set eth0 up" ;;
        cut-to-coordinator) drop "$net.$node" "$coordinator"; later "$deed_ms" "heal $cut" ;;
        cut-from-coordinator) drop "$coordinator" "$net.$node"; later "$deed_ms" "heal $cut" ;;
        cut-application) drop "$net.$node" "$application" both; later "$deed_ms" "heal $cut" ;;
        cut-neighbour)
            [ "$node" != "$deed_other" ] || { skip "there is one node"; return; }
            drop "$net.$node" "$net.$deed_other" both; later "$deed_ms" "heal $cut" ;;
        loss) drop "$net.$node" any both "$deed_percent"; later "$deed_ms" "heal $cut" ;;
    esac
    deeds[$deed]=$((${deeds[$deed]:-0} + 1))
}
go_on() { kill -CONT "$1" 2>/dev/null || true; }
take_count() {
    if farmctl status -o json >"$work/status.json" 2>"$work/status.log"; then
        count_status "$work/status.json"
    else
        say "no figures of the coordinator: $(tail -n 1 "$work/status.log")"
    fi
}
undo_until() { # MILLISECONDS of the trouble
    local index
    for index in "${!undo[@]}"; do
        [ "${undo_at_ms[index]}" -le "$1" ] || continue
        ${undo[index]} # a command and its words
        unset "undo[index]" "undo_at_ms[index]"
    done
}
# Daemons that we did not end must run; those that were asked to leave must leave with 0.
look_after() {
    local node pid entry ended left=()
    for node in $(seq "$workers"); do
        pid=${worker_pid[$node]}
        if [ -n "$pid" ] && ! kill -0 "$pid" 2>/dev/null; then
            reap "$pid"
            ended="${worker_name[$node]} ended by itself with ${exit_code[$pid]}: $(tail -n 1 "$work/$life-${worker_name[$node]}.log")"
            # One that could not start, on a machine that has no time for it, is started again, as systemd does.
            if [ -s "$work/$life-${worker_name[$node]}.out" ]; then
                fault "$ended"
            else
                false_starts=$((false_starts + 1))
                say "$ended"
                [ "$false_starts" -le "$most_false_starts" ] || fail "$false_starts starts of workers failed"
            fi
            worker_pid[$node]=
            start_worker "$node"
        fi
    done
    if [ -n "$coordinator_pid" ] && ! kill -0 "$coordinator_pid" 2>/dev/null; then
        reap "$coordinator_pid"
        fault "the coordinator ended by itself with ${exit_code[$coordinator_pid]}"
        coordinator_pid=
        start_coordinator
    fi
    for entry in "${departing[@]}"; do
        pid=${entry% *}
        if kill -0 "$pid" 2>/dev/null; then left+=("$entry"); continue; fi
        reap "$pid"
        [ "${exit_code[$pid]}" = 0 ] || fault "${entry#* } was drained and ended with ${exit_code[$pid]}"
    done
    departing=("${left[@]}")
}

frame=0
start_frame() {
    frame=$((frame + 1))
    start_render "disturbed-$frame" $((render_seed + frame - 1)) "$spp"
    last_jobs='' last_change=$SECONDS
}
farm_looks_like() { { farmctl status; tail -n 1 "$work/disturbed-$frame.ndjson"; } 2>&1 | sed 's/^/    /'; }

count_before() { local name; take_count; for name in "${!counted[@]}"; do counted[$name]=$((-counted[$name])); done; }
count_before
start_frame
now; begun_ms=$now_ms
next_deed
over=
while :; do
    now; elapsed_ms=$((now_ms - begun_ms))
    look_after
    if [ -z "$over" ]; then
        undo_until "$elapsed_ms"
        if [ "$elapsed_ms" -ge $((trouble_s * 1000)) ]; then
            over=1
            undo_until $((elapsed_ms + 3600000))
            say "the trouble is over after $((elapsed_ms / 1000)) s; $(jobs_done "disturbed-$frame") jobs of frame $frame done"
        elif [ "$elapsed_ms" -ge "$deed_at_ms" ]; then
            act
            describe; seconds "$deed_at_ms"
            printf '%7s s  %-20s %s%s\n' "$in_seconds" "$deed" "$described" "$outcome"
            next_deed
        fi
    fi
    if ! kill -0 "$render_pid" 2>/dev/null; then
        end_render "disturbed-$frame"
        say "frame $frame is done after $((elapsed_ms / 1000)) s"
        [ -z "$over" ] || break
        start_frame
    fi
    jobs=$(jobs_done "disturbed-$frame")
    [ "$jobs" = "$last_jobs" ] || { last_jobs=$jobs last_change=$SECONDS; }
    if [ $((SECONDS - last_change)) -ge "$stall_patience_s" ]; then
        farm_looks_like
        fail "no job done in $stall_patience_s s: $jobs of frame $frame"
    fi
    sleep 0.1
done

# ---- The farm is whole again: all nodes with their devices, nothing left of the application, no process too many.

deadline=$((SECONDS + heal_patience_s))
while :; do
    look_after
    troubles=$(farmctl status -o json 2>&1 >"$work/status.json" && unwell "$work/status.json" "${worker_name[@]}") || true
    for entry in "${departing[@]}"; do troubles+=$'\n'"${entry#* } still drains"; done
    [ -n "$troubles" ] || break
    if [ "$SECONDS" -ge "$deadline" ]; then
        fault "after $heal_patience_s s without trouble: ${troubles//$'\n'/; }"
        farm_looks_like
        break
    fi
    sleep 0.5
done
take_count
for node in $(seq "$workers"); do
    executor_of "$node" "${worker_pid[$node]}"
    for pid in $(ip netns pids "$(ns "$node")"); do
        [[ " ${worker_pid[$node]} $executor ${departing[*]} " == *" $pid "* ]] ||
            fault "process $pid is left on node-$node: $(tr '\0' ' ' <"/proc/$pid/cmdline" 2>/dev/null)"
    done
done
end_all
if grep -l "panicked at" "$work"/disturbed-*.log; then fault "a panic: see above"; fi

# ---- The same, undisturbed, on a farm of its own

departing=()
start_farm quiet
shift_seed=0
[ -z "${SELFTEST:-}" ] || shift_seed=1000
identical=0
for number in $(seq "$frame"); do
    render "quiet-$number" $((render_seed + number - 1 + shift_seed)) "$spp"
    if cmp "$work/disturbed-$number.exr" "$work/quiet-$number.exr"; then
        verdict=identical
        identical=$((identical + 1))
    else
        verdict=DIFFERENT
    fi
    say "frame $number, $spp spp, $(figure "quiet-$number" jobs) jobs: undisturbed $(figure "quiet-$number" render_seconds) s," \
        "disturbed $(figure "disturbed-$number" render_seconds) s, $(figure "disturbed-$number" replanned) replanned: $verdict"
done

summary=
for kind in "${kinds[@]}"; do summary+=" $kind ${deeds[$kind]:-0},"; done
say "deeds:$summary not done $skipped; starts of workers that failed: $false_starts"
say "as the coordinator counts: ${counted[delivered]} results delivered, ${counted[replanned]} jobs replanned," \
    "${counted[stolen]} stolen, ${counted[speculations]} speculations"
if [ -n "${SELFTEST:-}" ]; then
    [ "$identical" = 0 ] || fail "selftest: another seed gave the same bytes"
    say "selftest: the comparison tells another seed"
    exit 0
fi
[ "$identical" = "$frame" ] || fail "$((frame - identical)) of $frame images differ: trouble seed $seed"
[ ${#failures[@]} = 0 ] || fail "byte-identical, but ${#failures[@]} faults: ${failures[*]}"
say "byte-identical"
