"""Values of Prometheus samples."""

from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.samples import Sample
from starlette.testclient import TestClient


def samples(client: TestClient) -> list[Sample]:
    reply = client.get("/metrics")
    assert reply.status_code == 200, reply.text
    assert reply.headers["content-type"].startswith("text/plain; version=")
    return [sample for family in text_string_to_metric_families(reply.text) for sample in family.samples]


def value(client: TestClient, name: str, **labels: str) -> float:
    """The sum of a metric over all samples with these labels."""
    return sum(s.value for s in samples(client) if s.name == name and labels.items() <= s.labels.items())
