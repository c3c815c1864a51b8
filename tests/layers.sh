#!/bin/sh
# Holds the layers of the code: who may include whom, which file may know which library, and that every
# global symbol carries its module's prefix. Run after a release build; prints each breach, exits 1.
cd "$(dirname "$0")/.." || exit 2
breaches=0

breach() {
    echo "layers: $*"
    breaches=$((breaches + 1))
}

# forbid WHERE PATTERN WHY: no file under WHERE includes what matches PATTERN.
forbid() {
    for hit in $(grep -rlE "#include [\"<]$2" $1 2>/dev/null); do
        breach "$hit includes $2: $3"
    done
}
# only PATTERN FILES WHY: nothing but FILES (an extended regex) includes it.
only() {
    for hit in $(grep -rlE "#include [\"<]$1" server client proto | grep -vE "^($2)$"); do
        breach "$hit includes $1: $3"
    done
}

forbid server/mpm '(server/[a-ln-z]|proto/|client/)' 'the solver stands alone'
forbid server/mpm '(cjson|microhttpd|zmq|hdf5|curl|pthread|time\.h|signal)' 'the solver does no I/O and reads no clock'
forbid proto '(server/|client/|cjson|zmq|hdf5)' 'proto is libc and xxHash only'
forbid client 'server/' 'the client knows the API, not the server'
for hit in $(grep -rlE '#include "server/mpm/' server --include='*.[ch]' | grep -v '^server/mpm/'); do
    grep -hE '#include "server/mpm/' "$hit" | grep -vqE '"server/mpm/(mpm|error)\.h"|fields\.def' &&
        breach "$hit includes the solver's inside"
done
only 'microhttpd.h' 'server/http\.[ch]' 'only http.c knows libmicrohttpd'
only 'zmq.h' '(server/(publish|zap)|client/subscribe)\.c' 'only the two ends of the socket, and who admits to it, know ZeroMQ'
only 'hdf5.h' 'client/store(_read)?\.c' 'only store.c and store_read.c know HDF5'
only 'curl/' 'client/request\.c' 'only request.c knows libcurl'
for hit in $(grep -rnE '\b(printf|fprintf|fopen|getenv|exit|clock_gettime|time)\(' server/mpm --include='*.c' |
    grep -v snprintf | cut -d: -f1,2); do
    breach "$hit: the solver neither prints nor asks the system"
done

# Symbols: mpm_ in the solver, frame_ in proto; elsewhere the file's name up to its first underscore.
# Words that a file may use besides: json.c also owns faults_, publish.c publisher_, and so on.
objects=build/release/obj
[ -d "$objects" ] || { echo "layers: build first (make)"; exit 2; }
for object in $(find "$objects/server" "$objects/client" "$objects/proto" -name '*.o'); do
    source=${object#"$objects"/}
    [ -f "${source%.o}.c" ] || continue # left from a file that is gone
    case $source in
    server/mpm/*) prefix='mpm' ;;
    proto/*) prefix='frame' ;;
    */main.o) continue ;;
    server/json.o) prefix='(json|fault|faults)' ;;
    client/cmd_*) prefix='cmd' ;;
    *) prefix=$(basename "$source" .o | sed 's/_.*//') ;;
    esac
    for symbol in $(nm -g --defined-only "$object" | awk '$2 ~ /[TDBRC]/ {print $3}' |
        grep -vE "^${prefix}(_|$)|^__|^_GLOBAL"); do
        breach "${source%.o}.c defines $symbol without the prefix $prefix"
    done
done

[ "$breaches" = 0 ] && echo "layers: in order"
[ "$breaches" = 0 ]
