"""What Ray starts instead of HAProxy: a script that amends the configuration, and cares for what is to happen when
HAProxy is killed.

Ray looks at HAProxy every second, believes the third failure, and needs some seconds more to replace it. For so long a
stand-in answers: HAProxy once more, with the last configuration that had routes. Ray knows nothing of it; the first
HAProxy of Ray's that has routes takes its port over. One that has none yet does not listen to requests, for it would
answer 404 to all.
"""

from pathlib import Path

STOPPED = "stopped"
"""A file of this name in HAProxy's directory: none is to stand in any more."""
HEAD = 10
"""Seconds that a client has to send the head of a request and, as far as HAProxy's buffer holds it, its body."""
IDLE_TUNNEL = 3600
"""Seconds for which a WebSocket may be silent."""
SCRIPT = """#!/bin/sh
here='{here}'

amend() {{  # Ray's configuration
    sed -i \\
        -e 's/^\\( *bind \\)[*]\\{{0,1\\}}:\\({stats}\\|{metrics}\\)$/\\1127.0.0.1:\\2/' \\
        -e 's/^defaults$/&\\n    timeout http-request {head}s\\n    timeout tunnel {tunnel}s/' \\
        -e 's/^frontend http_frontend$/&\\n    option http-buffer-request/' \\
        "$1"
}}

without_control() {{  # a configuration without the ports and sockets by which Ray knows its HAProxy
    sed -e '/^ *stats socket /d' -e '/^ *\\(load-\\)\\{{0,1\\}}server-state-/d' \\
        -e '/^frontend prometheus$/,/^frontend http_frontend$/{{/^frontend http_frontend$/!d}}' \\
        -e '/^listen stats$/,$d' "$1"
}}

if [ "$1" = stand-in-for ]; then
    read -r _ < "$here/alive.$2"  # ends when nobody holds the other end of the pipe any more
    rm -f "$here/alive.$2"
    [ "$(cat "$here/serving")" = "$2" ] && [ ! -e "$here/{stopped}" ] || exit 0
    without_control "$here/routed.cfg" > "$here/standin.cfg"
    echo $$ > "$here/standin"
    exec '{haproxy}' -db -dR -f "$here/standin.cfg"
fi

for argument; do
    [ "$before" = -f ] && config=$argument
    before=$argument
done
if [ -n "$config" ]; then
    amend "$config"
    if grep -q '^ *use_backend ' "$config"; then
        echo $$ > "$here/serving"
        cp "$config" "$here/routed.cfg"
        mkfifo "$here/alive.$$"
        setsid "$0" stand-in-for $$ > "$here/standin.log" 2>&1 &  # Ray ends the processes of a group together
        exec 9<> "$here/alive.$$"
        if [ -e "$here/standin" ]; then
            set -- "$@" -sf "$(cat "$here/standin")"
            rm "$here/standin"
        fi
    else
        sed -i '/^frontend \\(http\\|grpc\\)_frontend$/,/^[^ ]/{{/^ *bind /d}}' "$config"
    fi
fi
exec '{haproxy}' "$@"
"""
"""Statistics for this machine alone. Limits for the head of a request, and for a WebSocket on which nothing is said, to
which the limits for requests would apply else. A request is passed on once its body is there, or fills the buffer: so
who sends slowly occupies no replica."""


def script(directory: Path, binary: str, stats: int, metrics: int) -> str:
    """The script for a server whose HAProxy has its files in `directory`. stats, metrics: HAProxy's own ports."""
    return SCRIPT.format(
        here=directory,
        haproxy=binary,
        stats=stats,
        metrics=metrics,
        head=HEAD,
        tunnel=IDLE_TUNNEL,
        stopped=STOPPED,
    )
