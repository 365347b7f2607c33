"""An S3 server for tests: moto's, in a process of its own, with one bucket."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from unittest.mock import patch

BUCKET = "store"
SECRET = "not-to-be-told-4711"

_SERVER = """
import sys, time, logging
logging.getLogger("werkzeug").setLevel(logging.ERROR)
from moto.server import ThreadedMotoServer
server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
server.start()
print(*server.get_host_and_port(), flush=True)
sys.stdin.read()  # Until the tests end, however they end.
"""


@contextmanager
def s3_server() -> Iterator[Mapping[str, str]]:
    """The environment in which `s3://store/...` is on a server that lives as long as the block."""
    server = subprocess.Popen(
        [sys.executable, "-c", _SERVER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert server.stdin is not None
    assert server.stdout is not None
    try:
        host, port = server.stdout.readline().split()
        environment = {
            "AWS_ENDPOINT_URL": f"http://{host}:{port}",
            "AWS_ACCESS_KEY_ID": "test",
            "AWS_SECRET_ACCESS_KEY": SECRET,
            "AWS_DEFAULT_REGION": "us-east-1",
            # As is; no look at the machine's own settings, nor at a metadata service.
            "AWS_EC2_METADATA_DISABLED": "true",
            "AWS_CONFIG_FILE": os.devnull,
            "AWS_SHARED_CREDENTIALS_FILE": os.devnull,
        }
        with patch.dict(os.environ, environment):
            import s3fs

            s3fs.S3FileSystem.clear_instance_cache()
            s3fs.S3FileSystem().mkdir(BUCKET)
            yield environment
            s3fs.S3FileSystem.clear_instance_cache()
    finally:
        server.stdin.close()
        server.stdout.close()
        end = time.monotonic() + 5.0
        while server.poll() is None and time.monotonic() < end:
            time.sleep(0.05)
        if server.poll() is None:
            server.kill()
            server.wait()
