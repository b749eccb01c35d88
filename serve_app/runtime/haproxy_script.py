"""Wrapper script that Ray starts instead of HAProxy: edits the configuration, and bridges crashes of HAProxy.

Ray checks HAProxy every second and replaces it a few seconds after the third failure. Until then a stand-in answers:
HAProxy with the last configuration that had routes, unknown to Ray. The next HAProxy of Ray that has routes takes over
the port. An HAProxy without routes does not listen for requests, because it would respond to all of them with 404.
"""

from pathlib import Path

STOPPED = "stopped"
"""File in HAProxy's directory: no stand-in starts any more."""
REQUEST_TIMEOUT = 10
"""Seconds for a client to send the head of a request, and as much of the body as fits into HAProxy's buffer."""
TUNNEL_TIMEOUT = 3600
"""Seconds for which a WebSocket may be idle."""
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
"""Restricts the statistics to this machine. Limits the time to send a request, and sets the idle timeout of WebSockets,
to which the request timeouts would apply otherwise. A request is forwarded once its body has arrived or fills the
buffer, so that slow clients occupy no replica."""


def script(directory: Path, binary: str, stats: int, metrics: int) -> str:
    """The script for a server whose HAProxy has its files in `directory`. stats, metrics: HAProxy's own ports."""
    return SCRIPT.format(
        here=directory,
        haproxy=binary,
        stats=stats,
        metrics=metrics,
        head=REQUEST_TIMEOUT,
        tunnel=TUNNEL_TIMEOUT,
        stopped=STOPPED,
    )
