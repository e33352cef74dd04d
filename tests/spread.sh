#!/bin/sh
# What a large scene costs its application's uplink when eight nodes need it (30-programs-and-data.md section 2): hosts are
# network namespaces, the application's link carries 1 Gbit/s. Needs root, iproute2 and binaries.
#
#   BIN=target/release tests/spread.sh [SCENE]
#   PEERS=no tests/spread.sh       nodes do not reach each other: each fetches from the application
#
# Prints the bytes that left the application in a first render and in a second one of the same scene, and when the last
# node began its first job. Without a scene it writes one of some 100 MB.
set -eu
bin=$(realpath "${BIN:-target/release}")
scene=${1:-}
nodes=8
net=10.71.7
work=$(mktemp -d)
pids=""

clean_up() {
    for pid in $pids; do kill -9 "$pid" 2>/dev/null || true; done
    for host in app $(seq "$nodes"); do
        ip link delete "gls$host" 2>/dev/null || true
        ip netns delete "glspread-$host" 2>/dev/null || true
    done
    ip link delete glspread 2>/dev/null || true
    iptables -D FORWARD -i glspread -o glspread -j ACCEPT 2>/dev/null || true
    rm -rf "$work"
}
trap clean_up EXIT INT TERM

if [ -z "$scene" ]; then
    scene=$work/scene
    "$bin/farmctl" scene atrium "$scene" --triangles 1400000 >/dev/null
fi

ip link add glspread type bridge
ip addr add "$net.254/24" dev glspread
ip link set glspread up
# Where Docker runs, bridges forward only what is let through.
iptables -I FORWARD -i glspread -o glspread -j ACCEPT 2>/dev/null || true

# A host of its own: namespace glspread-NAME at address NET.NUMBER.
host() {
    ip netns add "glspread-$1"
    ip link add "gls$1" type veth peer name eth0 netns "glspread-$1"
    ip link set "gls$1" master glspread up
    ip -n "glspread-$1" addr add "$net.$2/24" dev eth0
    ip -n "glspread-$1" link set lo up
    ip -n "glspread-$1" link set eth0 up
}

ready() {
    for _ in $(seq 600); do
        [ -s "$1" ] && return
        sleep 0.1
    done
    echo "nothing ready in $1" >&2
    exit 1
}

"$bin/farm-coordinator" --listen "$net.254:4100" --http 127.0.0.1:0 >"$work/coordinator" 2>"$work/coordinator.log" &
pids="$pids $!"
ready "$work/coordinator"
host app 100
ip -n glspread-app link set eth0 mtu 1500
ip netns exec glspread-app tc qdisc add dev eth0 root tbf rate 1gbit burst 256kb latency 50ms
for node in $(seq "$nodes"); do
    host "$node" "$node"
    for peer in $(seq "$nodes"); do
        [ "${PEERS:-yes}" = yes ] || [ "$peer" = "$node" ] ||
            ip -n "glspread-$node" route add unreachable "$net.$peer/32"
    done
    ip netns exec "glspread-$node" "$bin/farm-worker" --coordinator "$net.254:4100" --listen "$net.$node:0" \
        --name "node-$node" --device cpu >"$work/node-$node" 2>"$work/node-$node.log" &
    pids="$pids $!"
done
for node in $(seq "$nodes"); do ready "$work/node-$node"; done

sent() { ip -n glspread-app -s -j link show eth0 | sed 's/.*"tx":{"bytes":\([0-9]*\).*/\1/'; }
render() {
    before=$(sent)
    ip netns exec glspread-app "$bin/farmctl" --coordinator "$net.254:4100" render "$scene" -o "$work/$1.exr" \
        --size 256x256 --spp 1 --seed "$2" 2>&1 | tail -1
    echo "$1 render: $(($(sent) - before)) bytes left the application"
}
render first 1
"$bin/farmctl" --coordinator "$net.254:4100" timeline @last -o json >"$work/timeline"
python3 - "$work/timeline" <<'PYTHON'
import json, sys

segments = json.load(open(sys.argv[1]))["segments"]
begun = {}
for segment in segments:
    node = segment["node"]
    begun[node] = min(begun.get(node, segment["staged_at"]), segment["staged_at"])
scheduled = min(segment["scheduled_at"] for segment in segments)
print(f"{len(begun)} nodes ran jobs; the last one had its contents {(max(begun.values()) - scheduled) / 1e9:.2f} s after the plan")
PYTHON
render second 2
