"""Exceptions: what the command line says of them, and the memory that they hold."""

from __future__ import annotations

import inspect
import os
import sys
from collections.abc import Iterator
from traceback import walk_tb
from typing import Any

from extrags.errors import ExtragsError

__all__ = ["describe_error", "is_connection_error", "release_locals"]

SUSPENDED = inspect.CO_COROUTINE | inspect.CO_ASYNC_GENERATOR
"""Kinds of functions that may have caught the exception and wait in an event loop for something else, as the
clients of Prefect and Dask do: clearing their frames would end them. No stage is one."""

REFUSED = (401, 403)
"""Answers of HTTP to who may not ask."""

SEE_TRACEBACK = "run again with --debug for the traceback"


def describe_error(error: BaseException) -> list[str]:
    """Describe an exception in one line, and a hint in a second line if there is one.

    An `ExtragsError` in the chain of causes is shown as its message, a connection error as an unreachable
    server, and a refusal of Prefect's server as one; any other exception by its type and message, with a hint
    to the traceback.
    """
    for cause in _causes(error):
        if isinstance(cause, ExtragsError):
            return [_line(str(cause)), *getattr(cause, "__notes__", [])]
    for cause in _causes(error):
        if _is_refused(cause):
            return [_refusal(cause)]
        if is_connection_error(cause):
            return [f"a server went away or was never there: {_named(cause)}", _server_hint()]
    return [_named(error), SEE_TRACEBACK]


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__


def _named(error: BaseException) -> str:
    return _line(f"{type(error).__name__}: {error}".rstrip(": "))


def _line(text: str) -> str:
    return " ".join(text.split())


def is_connection_error(error: BaseException) -> bool:
    """Whether a connection was lost or refused: to Prefect's server, a Dask scheduler or an object store."""
    # Look up the modules instead of importing them: if one is not loaded, the error cannot come from it.
    kinds = [
        ("httpx", "TransportError"),
        ("distributed.comm.core", "CommClosedError"),
        ("botocore.exceptions", "ConnectionError"),
        ("botocore.exceptions", "HTTPClientError"),
    ]
    loaded = [getattr(sys.modules[module], name) for module, name in kinds if module in sys.modules]
    return isinstance(error, (ConnectionError, *loaded))


def _is_refused(error: BaseException) -> bool:
    """Whether Prefect's server does not take the user and password, or the key, that it was given."""
    exceptions = sys.modules.get("prefect.exceptions")
    if exceptions is None or not isinstance(error, exceptions.PrefectHTTPStatusError):
        return False
    return error.response.status_code in REFUSED


def _refusal(error: Any) -> str:
    where, answer = error.request.url.netloc.decode(), error.response
    return (
        f"the Prefect server at {where} refuses this command: {answer.status_code} {answer.reason_phrase}; "
        "set PREFECT_API_AUTH_STRING to the USER:PASSWORD that it was started with, or PREFECT_API_KEY to "
        "your key of Prefect Cloud"
    )


def release_locals(error: BaseException) -> None:
    """Let go of the local variables in the tracebacks of an exception, its causes and contexts.

    A traceback keeps all frames that the exception has left, with the images and mapped files in them, for
    as long as the exception is kept. Files, line numbers and messages stay. Frames that still run keep
    theirs.
    """
    found: dict[int, BaseException] = {}
    waiting: list[BaseException | None] = [error]
    while waiting:
        item = waiting.pop()
        if item is None or id(item) in found:
            continue
        found[id(item)] = item
        waiting += [item.__cause__, item.__context__]
    for item in found.values():
        for frame, _ in walk_tb(item.__traceback__):
            if frame.f_code.co_flags & SUSPENDED:
                continue
            try:
                frame.clear()
            except RuntimeError:  # It still runs.
                continue


def _server_hint() -> str:
    address = os.environ.get("PREFECT_API_URL")
    server = (
        f"the Prefect server at {address}" if address else "the server of the run, or of its Dask cluster,"
    )
    return f"see whether {server} is up, and run again: what is finished stays in the store"
