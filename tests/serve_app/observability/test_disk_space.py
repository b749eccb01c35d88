"""Disk space: measured in threads, so that a disk that does not respond blocks nothing."""

import os
import shutil
from pathlib import Path
from threading import Event

import pytest

from league.settings import Storage
from serve_app.observability.metrics_reporter import DiskSpace
from tests.support.waiting import until


def test_both_disks_are_measured(tmp_path: Path) -> None:
    disks = DiskSpace(Storage.at(tmp_path))
    (tmp_path / "artifacts").mkdir()
    disks.report()
    until(lambda: len(disks._sizes) == 2)
    report = disks.report()
    expected = shutil.disk_usage(tmp_path)
    assert {disk for (disk,), _ in report["league_disk_free_bytes"]} == {"home", "artifacts"}
    for (_,), size in report["league_disk_size_bytes"]:
        assert size == pytest.approx(expected.used + expected.free, rel=0.01)


def test_a_disk_that_does_not_respond_has_no_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answers, asked = Event(), []

    def statvfs(path: Path) -> os.statvfs_result:
        if path.is_relative_to(tmp_path):  # a server of other tests measures its disks as well
            asked.append(path)
        answers.wait(60)
        raise OSError

    monkeypatch.setattr(os, "statvfs", statvfs)
    disks = DiskSpace(Storage.at(tmp_path))
    try:
        for _ in range(3):
            assert disks.report() == {"league_disk_free_bytes": [], "league_disk_size_bytes": []}
        assert len(asked) == 2, "one measurement per disk is waiting"
    finally:
        answers.set()
