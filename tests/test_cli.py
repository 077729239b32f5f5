"""The command `sb3-yann`: what it prints and writes, and what its exit codes say."""

import shutil
import sys
import zipfile

import numpy as np
import pytest
from stable_baselines3 import DDPG, PPO, SAC

from fresh_process import run_module
from improvement_samples import quickest
from sb3_yann import Controller, LinearMPC, PiecewiseAffine, YannPolicy, export
from sb3_yann.cli import main
from sb3_yann.evaluation import evaluate
from twin_samples import Cart, problem

PLANT = """
import dataclasses
import functools
from sb3_yann import RateLimits
from twin_samples import Cart, problem
cart = problem
Short = functools.partial(Cart, 15)

def rated():
    return dataclasses.replace(problem(), rate=RateLimits(-0.5, 0.5))
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A user's folder, with a module of his own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "my_cart.py").write_text(PLANT)
    return tmp_path


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    model = DDPG(YannPolicy, Cart(), device="cpu", seed=0, learning_starts=0)
    model.policy.critic_warmup = 0
    model.learn(40)
    path = tmp_path_factory.mktemp("model") / "cart.zip"
    model.save(path)
    return path


@pytest.fixture
def model(folder, saved):
    return shutil.copy(saved, folder)


def test_solve_prints_the_report_and_saves_the_law(folder, capsys) -> None:
    assert main(["solve", "my_cart:cart", "--save", "law.npz"]) == 0
    law = PiecewiseAffine.load(folder / "law.npz")
    assert f"The law has {law.n_regions} regions" in capsys.readouterr().out
    assert law == problem().explicit()


def test_a_picture_without_a_suffix_is_said_to_lie_where_it_does(folder, capsys) -> None:
    assert main(["plot", "my_cart:cart", "law"]) == 0
    assert capsys.readouterr().out == "Written: law.png\n" and (folder / "law.png").exists()


def test_evaluate_plays_the_mpc_beside_the_model(model, capsys) -> None:
    assert main(["evaluate", "cart.zip", "--env", "my_cart:Cart", "--episodes", "3"]) == 0
    printed = capsys.readouterr().out
    assert "3 episodes from seed 0" in printed
    costs = evaluate(problem().explicit(), Cart, range(3)).costs
    assert f"instead of {np.mean(costs):.5g} over 3" in printed


def test_plot_draws_a_law_from_its_file_from_a_model_and_from_a_problem(model, folder) -> None:
    problem().explicit().save(folder / "law.npz")
    for given in ("law.npz", "cart.zip", "my_cart:cart"):
        assert main(["plot", given, "law.png"]) == 0
        assert (folder / "law.png").stat().st_size > 5000
        (folder / "law.png").unlink()
    assert main(["plot", "law.npz", "law.png", "--axes", "0", "7"]) == 1


def test_export_writes_code_and_says_what_it_costs(model, folder, capsys) -> None:
    assert main(["export", "cart.zip", "cart.c", "--float", "--name", "wagon"]) == 0
    assert "multiplications" in capsys.readouterr().out
    assert (folder / "cart.c").exists() and (folder / "cart_selftest.c").exists()
    assert "typedef float wagon_real" in (folder / "cart.h").read_text()
    assert main(["export", "my_cart:cart", "cart.npz"]) == 0
    u = Controller.load("cart.npz").evaluate([0.3, 0.1])
    assert np.allclose(u, problem().explicit()([0.3, 0.1]))
    assert main(["export", "cart.zip", "cart.doc"]) == 1
    assert main(["export", "cart", "same.c", "--float", "--name", "wagon"]) == 0
    assert (folder / "same_selftest.c").read_text().replace("same", "cart") == (
        folder / "cart_selftest.c"
    ).read_text()


def test_export_takes_checks_and_keeps_the_rates_of_a_problem(folder, capsys) -> None:
    (folder / "limits.json").write_text('{"obs_min": [-2, -3], "frozen_after": 9}')
    assert main(["export", "my_cart:cart", "cart.npz", "--checks", "limits.json"]) == 0
    data = Controller.load("cart.npz").data
    assert data["obs_min"].tolist() == [-2, -3] and data["frozen_after"] == 9
    assert main(["export", "my_cart:rated", "rated.npz"]) == 0
    assert Controller.load("rated.npz").data["change"].shape == (2, 1)
    for text, said in (("{", "no JSON"), ('{"obs_mn": 1}', "are obs_min"), ("[]", "a mapping")):
        (folder / "limits.json").write_text(text)
        assert main(["export", "my_cart:cart", "not.npz", "--checks", "limits.json"]) == 1
        assert said in capsys.readouterr().err and not (folder / "not.npz").exists()


def test_report_writes_one_page(model, folder) -> None:
    with_env = ["report", "cart", "with.html", "--env", "my_cart:Cart", "--episodes", "2"]
    assert main(["report", "cart", "without.html"]) == main(with_env) == 0
    without, played = (folder / f"{name}.html" for name in ("without", "with"))
    assert without.read_text().startswith("<!") and len(played.read_text()) > 1.2 * len(
        without.read_text()
    )


def test_commission_writes_a_record_and_goes_on_with_it(model, folder, capsys, monkeypatch) -> None:
    quickest(monkeypatch)
    again = ["commission", "cart", "--env", "my_cart:Short", "--record", "record", "--batch", "2"]
    assert main([*again, "--batches", "1", "--save", "done"]) == 0
    assert (folder / "record").exists() and (folder / "done.zip").exists()
    assert "batch" in capsys.readouterr().out.lower()
    assert main([*again, "--batches", "1"]) == 0  # nothing is left to do


def write_files(folder) -> None:
    problem().explicit().save(folder / "law.npz")
    export(problem(), folder / "controller.npz")
    content = (folder / "law.npz").read_bytes()
    (folder / "damaged.npz").write_bytes(content[: len(content) // 2])
    (folder / "text.npz").write_text("a law")
    with zipfile.ZipFile(folder / "empty.zip", "w") as archive:
        archive.writestr("note", "no model")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["solve", "nowhere"], "No problem is registered"),
        (["solve", "no_such_module:mpc"], "no module"),
        (["solve", "my_cart:Cart"], "expected a LinearMPC"),
        (["evaluate", "none.zip", "--env", "my_cart:Cart"], "There is no model none.zip"),
        (["evaluate", "mlp", "--env", "Pendulum-v1"], "holds TD3Policy as its policy: sb3-yann ne"),
        (["evaluate", "sac", "--env", "Pendulum-v1"], "sac holds SACPolicy as its policy"),
        (["export", "ppo", "p.c"], "ppo holds ActorCriticPolicy as its policy"),
        (["plot", "empty.zip", "p.png"], "empty.zip holds nothing that is known as its policy"),
        (["evaluate", "m", "--env", "E", "--episodes", "0"], "--episodes = 0 must be a whole numb"),
        (["evaluate", "m", "--env", "E", "--seed", "-1"], "--seed = -1 must be a whole number of"),
        (["report", "m", "page.html", "--episodes", "-1"], "--episodes = -1 must be a whole num"),
        (["plot", "text.npz", "p.png"], "text.npz does not hold a law (it is no .npz file"),
        (["plot", "damaged.npz", "p.png"], "damaged.npz does not hold a law ("),
        (["export", "damaged.npz", "p.c"], "damaged.npz does not hold a law ("),
        (["export", "controller.npz", "p.c"], "does not hold a PiecewiseAffine (it has no '"),
        (["solve", "nowhere", "--save", "no/law.npz"], "There is no folder no: make it first"),
        (["solve", "nowhere", "--save", "."], ". is a folder; name a file in it"),
        (["solve", "nowhere", "--save", "law.c"], "--save law.c: a law is written as .npz"),
        (["report", "law.npz", "page.html"], "law.npz is no model"),
        (["commission", "none", "--env", "my_cart:Cart", "--record", "r"], "There is no model"),
    ],
)
def test_what_cannot_be_done_is_an_exit_code_of_one_and_a_sentence(
    arguments, said, folder, capsys
) -> None:
    for name, kind in (("mlp", DDPG), ("sac", SAC), ("ppo", PPO)):
        if name in arguments:
            kind("MlpPolicy", "Pendulum-v1", device="cpu").save(folder / name)
    write_files(folder)
    assert main(arguments) == 1
    printed = capsys.readouterr().err
    assert printed.startswith(f"sb3-yann {arguments[0]}: ") and said in printed
    assert "Traceback" not in printed


def test_traceback_shows_where_an_error_came_from(folder) -> None:
    with pytest.raises(ValueError, match="No problem is registered"):
        main(["--traceback", "solve", "nowhere"])


def test_ctrl_c_is_an_exit_code(folder, monkeypatch, capsys) -> None:
    def interrupted(*_, **__) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(LinearMPC, "explicit", interrupted)
    assert main(["solve", "my_cart:cart"]) == 130
    assert "Interrupted" in capsys.readouterr().err


def test_it_runs_as_a_module(folder) -> None:
    assert "The law has 7 regions" in run_module(folder, "sb3_yann", "solve", "CSTR-v0")
