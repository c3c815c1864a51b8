#!/bin/sh
# make demo: the paper's dam break at its full size, F-bar on and off side by side on a daemon of its own;
# records both through ZeroMQ, draws the water at the paper's four times, and stops what it started.
# `scenes/demo.sh pictures` only draws the recordings of an earlier demo again.
set -eu
cd "$(dirname "$0")/.."
out=build/demo
work= daemon= standard= fbar=
mkdir -p "$out"

stop() {
    for process in "$@"; do
        kill "$process" 2>/dev/null || true
    done
    for process in "$@"; do
        wait "$process" 2>/dev/null || true
    done
}
cleanup() {
    trap '' INT TERM HUP
    trap - EXIT
    stop $fbar $standard
    stop $daemon
    [ -z "$work" ] || rm -rf "$work"
}
trap cleanup EXIT
trap 'cleanup; exit 130' INT
trap 'cleanup; exit 143' TERM HUP

plot() {
    build/fbar plot "$@" --field mean_stress --axes 0:6,0:4.5 >/dev/null
}
draw() {
    for t in 0.4 1.0 1.5 2.0; do
        for update in standard fbar; do
            plot "$out/dam-break-$update.h5" --time "$t" -o "$out/dam-break-$update-$t.png"
        done
    done
    plot "$out/dam-break-standard.h5" "$out/dam-break-fbar.h5" --time 0.4,1.0,1.5,2.0 \
        -o "$out/dam-break.png"
    echo "pictures:   $out/dam-break.png, and one by one $out/dam-break-{standard,fbar}-{0.4,1.0,1.5,2.0}.png"
}
if [ "${1-}" = pictures ]; then
    draw
    exit
fi

begin=$(date +%s)
work=$(mktemp -d)
rm -f "$out"/dam-break* "$out"/*.log
# A session of its own: Ctrl-C reaches the clients first, and they end in order.
setsid build/fbard --http 127.0.0.1:0 --publish tcp://127.0.0.1:0 --port-file "$work/ports" \
    --data-dir "$work/data" --slots 2 --threads 1 2>"$out/fbard.log" &
daemon=$!
while [ ! -s "$work/ports" ]; do
    kill -0 "$daemon" 2>/dev/null || { cat "$out/fbard.log" >&2; exit 1; }
    sleep 0.05
done
url=$(sed -n 's/.*"http": *"\([^"]*\)".*/\1/p' "$work/ports")
echo "fbard at $url; two runs of scenes/dam-break.json, 3,200 particles x 206,000 steps each"

# Both in the background: only then does the shell attend to a signal at once.
build/fbar --url "$url" run dam-break --id fbar-off --set fbar=false \
    -o "$out/dam-break-standard.h5" >"$out/standard.log" 2>&1 &
standard=$!
echo "F-bar on (the standard update runs beside it):"
build/fbar --url "$url" run dam-break --id fbar-on -o "$out/dam-break-fbar.h5" &
fbar=$!
wait "$fbar" || exit 1
fbar=
wait "$standard" || { cat "$out/standard.log" >&2; exit 1; }
standard=

draw
echo "recordings: $out/dam-break-{standard,fbar}.h5, and .xdmf for ParaView"
grep ' completed: ' "$out/standard.log" # with the speed, as F-bar's above
echo "took $(($(date +%s) - begin)) s"
