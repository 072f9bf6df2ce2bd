"""Table of outcomes for third-party files: one line per case, which is a fault if its reader raises an unexpected error."""

import json

import cv2
import numpy as np

from benchmarks.stalks import outcomes


def test_each_case_has_a_line(tmp_path, capsys, monkeypatch):
    for name in ("calib/good", "ann/stalks", "ann/leaves", "files/pairs", "files/none", "odo/driven"):
        (tmp_path / name).mkdir(parents=True)
    lines = {
        name: f"P{place}: 500 0 20 {shift} 0 500 12 0 0 0 1 0\n" for place, (name, shift) in enumerate((("l", 0), ("r", -50)))
    }
    (tmp_path / "calib" / "good" / "calib.txt").write_text("".join(lines.values()))
    (tmp_path / "calib" / "bad.yaml").write_text("a: [1")
    for name in ("stalk", "leaf"):
        shapes = [{"label": name, "points": [[1, 1], [5, 1], [5, 9]], "shape_type": "polygon"}]
        about = {"imagePath": "a.png", "imageWidth": 40, "imageHeight": 24, "shapes": shapes}
        folder = tmp_path / "ann" / ("stalks" if name == "stalk" else "leaves")
        (folder / "a.json").write_text(json.dumps(about))
    for folder in ("files/pairs", "odo/driven"):
        for side in ("left", "right"):
            cv2.imwrite(str(tmp_path / folder / f"{side}_0|1.png"), np.zeros((24, 40), np.uint8))
    (tmp_path / "odo" / "driven" / "odometry.csv").write_text("left;distance_cm\nleft_0|1;25\n")
    assert outcomes.main([str(tmp_path)]) == 0
    table = capsys.readouterr().out.splitlines()
    rows = {tuple(line.split(" | ")[:2]): line for line in table[2:]}
    assert table[:2] == ["| kind | case | outcome |", "|---|---|---|"] and len(rows) == 7
    assert "refused: good does not say for which images it is" in rows["| calib", "good"]
    assert "refused: bad.yaml is not a calibration" in rows["| calib", "bad.yaml"]
    assert "1 images, 1 boxes (1 1 4 8), stalks: stalk (1)" in rows["| ann", "stalks"]
    assert "nothing is called a stalk there, but leaf (1)" in rows["| ann", "leaves"]
    assert "pairs: 1 of 1 pairs whole, 0\\|1" in rows["| files", "pairs"] and "no stereo pairs" in rows["| files", "none"]
    assert "0\\|1 0.2500 m" in rows["| odo", "driven"]

    def breaks(path):
        raise KeyError(path.name)

    monkeypatch.setitem(outcomes.KINDS, "odo", breaks)
    assert outcomes.main([str(tmp_path)]) == 1
    assert "FAULT KeyError: 'driven'" in capsys.readouterr().out
