"""The kernel: what a league, a checkpoint version, a policy and a result are."""

import os

REPORTS_OFF = {
    "ORT_DISABLE_TELEMETRY": "1",
    "RAY_USAGE_STATS_ENABLED": "0",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "WANDB_ERROR_REPORTING": "false",
    "COMET_ERROR_TRACKING_ENABLE": "false",
}
"""Environment variables by which libraries do not report their use and errors to their makers. They are read when the
library is imported, and every process of the project imports this package before.
"""
for _name, _value in REPORTS_OFF.items():
    os.environ.setdefault(_name, _value)
