"""Notes every connection of a process before it is made, and refuses those that leave this machine."""

import ipaddress
import json
import os
import socket
import sys

_LOG = os.environ["EXTRAGS_NETWORK_LOG"]


def _is_local(host):
    if host in (None, "", b"", "localhost", b"localhost", socket.gethostname()):
        return True
    text = host.decode() if isinstance(host, bytes) else str(host)
    try:
        address = ipaddress.ip_address(text.split("%")[0])
    except ValueError:
        return False
    return address.is_loopback or address.is_unspecified


def _note(what, host):
    local = _is_local(host)
    text = host.decode(errors="replace") if isinstance(host, bytes) else str(host)
    with open(_LOG, "a", encoding="utf-8") as log:
        log.write(json.dumps({"what": what, "to": text, "local": local, "by": sys.argv[:3]}) + "\n")
    return local


# The hooks see what C code and libraries ask for as well.
def _hook(event, arguments):
    if event in ("socket.connect", "socket.sendto"):
        address = arguments[1]
        host = address[0] if isinstance(address, tuple) else None
    elif event in ("socket.getaddrinfo", "socket.gethostbyname"):
        host = arguments[0]
    else:
        return
    if host is not None and not _note(event, host):
        raise OSError(f"no connection to {host}: the tests allow none")


sys.addaudithook(_hook)
