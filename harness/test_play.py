"""Tests of playing a run."""

import shutil

import numpy as np
from PIL import Image

from harness import records
from harness.play import play


def test_playing_a_run(whole, tmp_path, capsys):
    folder, picture = tmp_path / "from_a_gpu", tmp_path / "a.gif"
    shutil.copytree(whole, folder)
    records.write_config(folder, {**records.read_config(whole), "device": "cuda"})
    rates = play(folder, str(picture))
    out = capsys.readouterr().out
    assert rates.shape == (2,) and np.all((rates >= 0) & (rates <= 1))
    assert f"success {rates.mean():.3f} over 20 episodes" in out and "after epoch 4" in out
    with Image.open(picture) as gif:
        assert gif.size == (240, 240) and gif.n_frames > 20
        frames = []
        for i in range(gif.n_frames):
            gif.seek(i)
            frames.append(np.asarray(gif.convert("RGB")).astype(int))
    assert np.abs(np.diff(frames, axis=0)).max() > 50  # something moves
