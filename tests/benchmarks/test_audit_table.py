"""Table of audits of rewards, from records as `jaxrl-vis audit --json` writes them."""

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import check_claims
from benchmarks.ledger import pages
from benchmarks.ledger.tables import audit
from jaxrl_vis.errors import RequestError
from jaxrl_vis.studies.audit.report import COLUMNS

PAGE = "docs/indicator_rewards.md"


def record(env: str, *rewards: str, revision: str | None = "abcdef0123456789", **options: Any) -> dict[str, Any]:
    asked = {"env": env, "image_size": 64, "pixels": "rgbd", "noise": 0.0, "episodes": 64, "goals": 32, "sequences": 128}
    figures = {key: place / 8 for place, key in enumerate(COLUMNS)}
    return {
        "audit": {**asked, "tolerance": 8.0, "tolerance_share": 0.99, **options},
        "revision": revision,
        "device": "A GPU",
        "rewards": dict.fromkeys(rewards, figures),
    }


def store(results: Path, **records: dict[str, Any]) -> None:
    (results / audit.FOLDER).mkdir()
    for name, contents in records.items():
        (results / audit.FOLDER / f"{name}.json").write_text(json.dumps(contents))


def test_without_records_the_page_stays_as_it_is(tmp_path: Path) -> None:
    text = "<!-- audit: begin (make tables) -->\n<!-- audit: end -->\n"
    assert audit.audit_table(tmp_path) is None
    assert pages.fill_page(text, {"audit": audit.audit_table}, tmp_path) == text


def test_each_reward_of_each_task_has_a_row_and_its_origin(tmp_path: Path) -> None:
    rewards = ("indicator", "runs/autoencoder", "/elsewhere/classifier", "own:reward")
    store(tmp_path, b=record("VisualFar", *rewards, image_size=100, noise=5.0), a=record("VisualNear", "features"))
    table = audit.audit_table(tmp_path)
    assert table is not None
    head, _, near, *far = table.splitlines()[:7]
    assert head.split(" | ")[2:4] == ["false +", "false -"] and head.endswith("solved | solvable |")
    assert near == "| VisualNear, 64x64 rgbd | `features` | 0.000 | 0.125 | 0.250 | 0.375 | 0.500 | 0.625 | 0.750 | 0.875 |"
    assert [row.split("|")[2].strip() for row in far] == [
        "`indicator`",
        "autoencoder, trained",
        "classifier, trained",
        "`own:reward`",
    ]
    assert far[0].startswith("| VisualFar, 100x100 rgbd, noise 5 |") and far[1].startswith("| | autoencoder")
    text = " ".join(table.split())
    settings = "32 goals with 128 action sequences each; `indicator_tolerance` tolerates 8 grey levels in 0.99 of the elements."
    assert text.endswith(f"{settings} Made by abcdef0 on A GPU.")


def test_audits_with_other_settings_or_without_a_revision_are_distinguished() -> None:
    table = audit.rows([record("VisualNear", "features"), record("VisualFar", "features", goals=8, revision=None)])
    text = " ".join(table.split())
    assert "VisualNear: 64 episodes, 32 goals with 128" in text and "VisualFar: 64 episodes, 8 goals with 128" in text
    assert text.endswith("Made by abcdef0, unknown on A GPU.")


def test_a_damaged_record_is_named(tmp_path: Path) -> None:
    store(tmp_path, a=record("VisualNear", "features"))
    (tmp_path / audit.FOLDER / "b.json").write_text('{"audit": {')
    with pytest.raises(RequestError, match="b.json is not JSON"):
        audit.audit_table(tmp_path)


def test_an_edited_table_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store(tmp_path, a=record("VisualNear", "features"))
    monkeypatch.setitem(pages.PAGES[PAGE], "audit", lambda _: audit.audit_table(tmp_path))
    monkeypatch.setattr(check_claims, "LEARNING_TABLES", {PAGE: "audit"})
    monkeypatch.setattr(check_claims, "CHECKOUT", tmp_path)
    page = tmp_path / PAGE
    page.parent.mkdir()
    page.write_text(f"<!-- audit: begin -->\n{audit.audit_table(tmp_path)}\n<!-- audit: end -->\n")
    assert list(check_claims.ledger_differences()) == []
    page.write_text(page.read_text().replace("0.125", "0.124"))
    assert list(check_claims.ledger_differences()) == [f"{PAGE}: the table 'audit' differs from the records: make tables"]
