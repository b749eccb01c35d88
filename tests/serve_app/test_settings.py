"""Limits are consistent, and Ray Serve accepts deploy.yaml."""

from typing import Any

import pytest
import yaml
from pydantic import ValidationError

from league.registry.replicas import LIVENESS_TIMEOUT
from serve_app.runtime.launch import DEPLOY_YAML
from serve_app.settings import ServeSettings


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"heartbeat": 6}, "heartbeat must be at most 5"),
        ({"poll": 10}, "poll_slowest must be at least poll"),
        ({"max_body": 1}, "max_body"),
        ({"max_bodies": 1}, "max_bodies"),
        ({"root_path": "ai"}, "expected a path like /ai"),
        ({"root_path": "/ai/"}, "expected a path like /ai"),
        ({"root_path": "/ai?x"}, "expected a path like /ai"),
        ({"root_path": "/leagues"}, "begins like a path of this server"),
        ({"root_path": "/v1/ai"}, "begins like a path of this server"),
        ({"cors_origins": ["*"]}, "expected an origin like"),
        ({"cors_origins": ["https://game.example/"]}, "expected an origin like"),
        ({"cors_origins": ["https://game.example"], "require_keys": "never"}, "cors_origins needs API keys"),
    ],
)
def test_inconsistent_settings_are_rejected(setting: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        ServeSettings.model_validate(setting)


def test_two_heartbeats_may_be_lost() -> None:
    assert 3 * ServeSettings().heartbeat <= LIVENESS_TIMEOUT.total_seconds()


def test_deploy_yaml_updates_without_lost_requests() -> None:
    from ray.serve.config import AutoscalingConfig
    from ray.serve.schema import ServeDeploySchema

    schema = ServeDeploySchema.model_validate(yaml.safe_load(DEPLOY_YAML.read_text()))
    (application,) = schema.applications
    (deployment,) = application.deployments
    assert application.import_path == "serve_app.app:build_app"
    ServeSettings.model_validate(application.args)
    assert schema.http_options.host == "127.0.0.1"
    replicas = AutoscalingConfig.model_validate(deployment.autoscaling_config)
    assert replicas.min_replicas >= 2, "one replica may fail"
    assert replicas.min_replicas == replicas.max_replicas, "evaluations share the cores"
    assert deployment.max_surge_percent == 100, "new replicas start before old ones stop"
    assert deployment.graceful_shutdown_timeout_s >= 40, "draining takes 30 s"
    assert deployment.backpressure_config.status_code == 429
    both = 2 * replicas.max_replicas * deployment.ray_actor_options.num_cpus
    assert both <= 2, "old and new replicas must fit on two cores"
