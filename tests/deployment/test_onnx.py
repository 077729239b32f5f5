"""An ONNX graph of an export is the controller, under onnxruntime."""

import sys

import numpy as np
import pytest

from deployed import CASES, observations, policy_of
from sb3_yann import Controller, export
from sb3_yann.deployment.code import insensitive

onnx = pytest.importorskip("onnx")
runtime = pytest.importorskip("onnxruntime")


def both(name, folder, precision="double"):
    """Return the controller, and a function of observations that the runtime evaluates."""
    export(policy_of(name), folder / "plant.npz")
    export(policy_of(name), folder / "plant.onnx", precision=precision)
    session = runtime.InferenceSession(str(folder / "plant.onnx"))
    real = np.float64 if precision == "double" else np.float32
    return Controller.load(folder / "plant.npz"), lambda obs: session.run(
        None, {"obs": obs.astype(real)}
    )


@pytest.mark.parametrize("precision", ["double", "float"])
@pytest.mark.parametrize("name", CASES)
def test_a_graph_is_the_controller(name, precision, tmp_path):
    controller, run = both(name, tmp_path, precision)
    obs = observations(policy_of(name), 3_000)
    if precision == "float":
        obs = obs.astype(np.float32).astype(np.float64)
    kept = insensitive(controller, obs, precision)
    assert len(kept) > 0.4 * len(obs)
    actions, outside = run(kept)
    errors = np.abs(actions - controller.evaluate(kept)) / (2 * controller.data["action_scale"])
    assert errors.max() < (1e-12 if precision == "double" else 1e-5)
    assert np.array_equal(outside, ~controller.in_domain(kept))


@pytest.mark.parametrize("name", ["reactor", "references and rates", "mixed observations"])
def test_what_is_not_finite_counts_as_in_the_controller(name, tmp_path):
    controller, run = both(name, tmp_path)
    obs = observations(policy_of(name), 300)
    for i, row in enumerate(obs):
        row[i % obs.shape[1]] = [np.nan, np.inf, -np.inf][i % 3]
    found = run(obs)[0]
    assert np.all(np.isfinite(found))
    scale = 2 * controller.data["action_scale"]
    assert np.max(np.abs(found - controller.evaluate(obs)) / scale) < 1e-12


def test_a_graph_names_what_it_takes(tmp_path):
    written = export(policy_of("reactor"), tmp_path / "plant.onnx")
    said = {each.key: each.value for each in onnx.load(tmp_path / "plant.onnx").metadata_props}
    assert said == {
        "digest": written.digest, "obs_names": "C_A, C_B, C_S, T", "action_names": "U"
    }  # fmt: skip


def test_without_onnx_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ImportError, match="pip install onnx"):
        export(policy_of("reactor"), tmp_path / "plant.onnx")
    assert list(tmp_path.iterdir()) == []
