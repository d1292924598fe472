"""Files: one archive from the first byte to the last, and records that belong to whoever was first."""

from __future__ import annotations

import errno
import os
import threading

import numpy as np
import pytest
import torch

from torchrl_pomdp.files import DamagedFileError, claim, load_tensors, read_json, save_tensors, tensor_bytes


def test_an_archive_before_or_behind_another_one_is_refused(tmp_path):
    first, second = (tensor_bytes({"x": torch.full((8,), value)}) for value in (1.0, 2.0))
    for number, content in enumerate((first + second, b"PK" + first, first + b"\0", second[:40] + first)):
        path = tmp_path / f"{number}.pt"
        path.write_bytes(content)
        with pytest.raises(DamagedFileError, match=str(path)):
            load_tensors(path)


@pytest.mark.parametrize("value", [np.float64(3), np.int64(3), (1, 2)])
def test_what_cannot_be_read_back_is_not_written(tmp_path, value):
    with pytest.raises(TypeError, match="must be a tensor, a number, a text or a dictionary of them"):
        save_tensors(tmp_path / "a.pt", {"x": {"y": value}})
    assert not list(tmp_path.iterdir())


def no_links(*names):
    raise PermissionError(errno.EPERM, "Operation not permitted")


@pytest.mark.parametrize("links", [True, False])
def test_a_record_is_claimed_by_one_of_many(tmp_path, monkeypatch, links):
    if not links:
        monkeypatch.setattr(os, "link", no_links)
    for attempt in range(10):
        path, refused = tmp_path / str(attempt) / "config.json", []
        barrier = threading.Barrier(4)

        def compete(seed, path=path, refused=refused, barrier=barrier):
            barrier.wait()
            try:
                claim(path, {"seed": seed})
            except ValueError:
                refused.append(seed)

        threads = [threading.Thread(target=compete, args=(seed,)) for seed in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(refused) == 3
        assert [file.name for file in path.parent.iterdir()] == ["config.json"]
        (winner,) = set(range(4)) - set(refused)
        assert read_json(path) == {"seed": winner}


def test_a_kill_without_links_leaves_a_record_that_is_damaged(tmp_path, monkeypatch):
    """Between the name and its content: nobody takes the folder for their own."""

    class Killed(BaseException):
        pass

    def killed(*names):
        raise Killed

    path = tmp_path / "config.json"
    with monkeypatch.context() as patch:
        patch.setattr(os, "link", no_links)
        patch.setattr(os, "replace", killed)
        with pytest.raises(Killed):
            claim(path, {"seed": 0})
    with pytest.raises(DamagedFileError, match=f"{path} is damaged.*restore it or name another folder"):
        claim(path, {"seed": 0})


def test_a_record_that_is_no_file_claims_nothing(tmp_path):
    (tmp_path / "config.json").mkdir()
    with pytest.raises(OSError, match=r"config\.json"):
        claim(tmp_path / "config.json", {"seed": 0})
