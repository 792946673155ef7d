"""``rendezview assess``: how accurate a model is on its craft."""

from __future__ import annotations

from dataclasses import replace

from rendezview_ground.evaluate.assessment import LOOKS


def test_the_command_writes_tables_answers_and_a_picture(run, tmp_path, refining_model):
    model = tmp_path / "bumpy.rvm"
    refining_model.save(model)
    ran = run("assess", model, "--frames", 12, "--jobs", 1)
    assert ran.code == 0, ran
    assert "seen from" in ran.out
    assert "before the Earth" in ran.out
    assert "the Sun's direction" in ran.out
    assert len((tmp_path / "bumpy.assess.jsonl").read_text().splitlines()) == 12 * len(LOOKS)
    assert (tmp_path / "bumpy.assess.png").read_bytes().startswith(b"\x89PNG")
    replace(refining_model, shape=None).save(model)
    run("assess", model, "--frames", 12).says("carries no mesh", "target")
    run("assess", model, "hubble", "--frames", 12).says("radius", "hubble")
