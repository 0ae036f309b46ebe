"""An S3 server in this process."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.request import Request, urlopen

import pytest

from h3data.recording import storage


@contextmanager
def bucket() -> Iterator[str]:
    """URI of an empty bucket, found by the standard environment variables; skips where moto is missing."""
    server = pytest.importorskip("moto.server", reason="needs moto[server]")
    running = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        for name, value in (("ACCESS_KEY_ID", "k"), ("SECRET_ACCESS_KEY", "s"), ("DEFAULT_REGION", "us-east-1")):
            patch.setenv(f"AWS_{name}", value)
        patch.setenv("AWS_EC2_METADATA_DISABLED", "true")
        urlopen(Request(f"http://{host}:{port}/bucket", method="PUT")).close()
        yield "s3://bucket"
        storage._filesystem.cache_clear()
    running.stop()


@contextmanager
def read_only() -> Iterator[None]:
    """Within a `bucket`: the environment's credentials are those of somebody who may read and list, no more."""
    boto3 = pytest.importorskip("boto3")
    allowed = {"Effect": "Allow", "Action": ["s3:Get*", "s3:List*"], "Resource": "*"}
    iam = boto3.client("iam", endpoint_url=os.environ["AWS_ENDPOINT_URL"])
    iam.create_user(UserName="reader")
    policy = json.dumps({"Version": "2012-10-17", "Statement": [allowed]})
    iam.put_user_policy(UserName="reader", PolicyName="reads", PolicyDocument=policy)
    key = iam.create_access_key(UserName="reader")["AccessKey"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ACCESS_KEY_ID", key["AccessKeyId"])
        patch.setenv("AWS_SECRET_ACCESS_KEY", key["SecretAccessKey"])
        storage._filesystem.cache_clear()
        _ask_for_rights_after("0")
        try:
            yield
        finally:
            _ask_for_rights_after("inf")
            storage._filesystem.cache_clear()


def _ask_for_rights_after(requests: str) -> None:
    """Moto allows everything for that many requests."""
    url, header = f"{os.environ['AWS_ENDPOINT_URL']}/moto-api/reset-auth", {"Content-Type": "text/plain"}
    urlopen(Request(url, data=requests.encode(), headers=header, method="POST")).close()
