"""Logs: what they accept, what they refuse, and how they travel."""

import jax
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.identification import files
from tests.identification.worlds import small_policies, small_world
from tests.tools import assert_refused

X, U, DEPLOYED = small_world().logs(0, small_policies()[:2], 3, 5)


def with_value(array: np.ndarray, index: tuple, value: float) -> np.ndarray:
    changed = array.copy()
    changed[index] = value
    return changed


def same(one: pc.Logs, two: pc.Logs) -> bool:
    pairs = [*zip(one.x, two.x, strict=True), *zip(one.u, two.u, strict=True), (one.deployed, two.deployed)]
    return all(np.array_equal(a, b) for a, b in pairs) and np.array_equal(one.deployment, two.deployment)


def ragged() -> pc.Logs:
    lengths = [3, 5, 4, 2, 5, 5]
    x = [x[: length + 1] for x, length in zip(X, lengths, strict=True)]
    u = [u[: length + (e % 2 and length < 5)] for e, (u, length) in enumerate(zip(U, lengths, strict=True))]
    return pc.Logs(x, u, DEPLOYED)


def test_logs_group_episodes_by_policy_in_order_of_appearance() -> None:
    logs = pc.Logs(X, U, DEPLOYED[[0, 3, 0, 3, 3, 0]])
    assert logs.deployment.tolist() == [0, 1, 0, 1, 1, 0]
    assert np.array_equal(logs.policies, np.stack(small_policies()[:2]))
    assert len(logs) == 6 and logs.transitions == 30 and logs.memory == 1
    assert "2 policies (3, 3 episodes)" in str(logs)


def test_logs_take_one_policy_for_all_episodes_and_tell_zero_from_nothing() -> None:
    logs = pc.Logs(X, U, -0.0 * DEPLOYED[0])
    assert len(logs.policies) == 1
    both = logs + pc.Logs(X, U, 0.0 * DEPLOYED[0])
    assert len(both) == 12 and len(both.policies) == 1


def test_logs_simulated_obey_the_law_that_made_them() -> None:
    world = small_world()
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(world.A, world.B),
        horizon=5,
        gain=world.K,
        noise=pc.Uniform(-np.ones(2), np.ones(2)),
        cost=pc.QuadraticCost(np.eye(2), np.eye(1)),
    )
    logs = pc.Logs.simulate(problem, np.stack(small_policies()[:2]), jax.random.key(0), 3)
    assert np.array_equal(logs.deployment, [0, 0, 0, 1, 1, 1])
    for x, u, M in zip(logs.x, logs.u, logs.deployed, strict=True):
        w = x[1:] - x[:-1] @ world.A.T - u[:-1] @ world.B.T
        assert np.all(np.abs(w) <= 1 + 1e-6)
        v = u + x @ world.K.T
        np.testing.assert_allclose(v[1:], w @ M[0].T, atol=1e-6)
        np.testing.assert_allclose(v[0], 0, atol=1e-6)


@pytest.mark.parametrize("make", [lambda: pc.Logs(X, U, DEPLOYED), ragged], ids=["even", "ragged"])
def test_logs_come_back_bit_for_bit_from_csv_and_dataset(make, tmp_path) -> None:
    logs = make()
    logs.to_csv(tmp_path / "new" / "logs")
    assert same(pc.Logs.from_csv(tmp_path / "new" / "logs"), logs)
    assert same(pc.Logs.from_dataset(logs.to_dataset()), logs)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["logs"]


def test_signal_names_go_from_the_system_through_logs_files_and_fit_to_the_controller(tmp_path) -> None:
    control = pytest.importorskip("control")
    world = small_world()
    cost = pc.QuadraticCost(np.eye(2), np.eye(1))
    problem = pc.PerformativeProblem(
        system=pc.interop.from_control(
            control.ss(world.A, world.B, np.eye(2), 0, True, states=["level", "flow"], inputs=["valve"], outputs=2)
        ),
        horizon=12,
        gain=world.K,
        noise=pc.Uniform(-np.ones(2), np.ones(2)),
        cost=cost,
    )
    logs = pc.Logs.simulate(problem, np.stack(small_policies()[:2]), jax.random.key(0), 4)
    logs.to_csv(tmp_path / "logs")
    assert (tmp_path / "logs" / "episode_0.csv").read_text().splitlines()[0] == "t,level,flow,valve"
    for back in (pc.Logs.from_csv(tmp_path / "logs"), pc.Logs.from_dataset(logs.to_dataset()), logs[:3] + logs[3:]):
        assert same(back, logs)
        assert (back.state_names, back.input_names) == (("level", "flow"), ("valve",))
    fit = pc.fit(pc.Logs.from_csv(tmp_path / "logs"), world.K, directions=world.directions, reaction="constant")
    table = fit.table()
    assert float(table["A"].sel(value="estimate", state="flow", from_state="level")) == fit.A.mean[1, 0]
    assert float(table["B"].sel(value="estimate", state="level", input="valve")) == fit.B.mean[0, 0]
    fitted = fit.problem(cost=cost, horizon=5)
    controller = pc.interop.to_control(fitted, small_policies()[1])
    assert controller.output_labels == ["valve"] and controller.input_labels[:2] == ["level", "flow"]
    assert fit.ensemble(2, key=jax.random.key(0), cost=cost, horizon=5).system.state_names == ("level", "flow")


def test_columns_of_an_episode_are_found_by_the_names_of_the_policies(tmp_path) -> None:
    logs = pc.Logs(X, U, DEPLOYED, ["level", "flow"], ["valve"])
    logs.to_csv(tmp_path / "logs")
    path = tmp_path / "logs" / "episode_2.csv"
    rows = [line.split(",") for line in path.read_text().splitlines()]
    path.write_text("\n".join(",".join([u, b, t, a, "note" if t == "t" else "0"]) for t, a, b, u in rows))
    assert same(pc.Logs.from_csv(tmp_path / "logs"), logs)


def test_logs_are_written_whole_or_not_at_all(tmp_path, monkeypatch) -> None:
    logs = pc.Logs(X, U, DEPLOYED)

    def broken(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(files, "_write_rows", broken)
    with pytest.raises(OSError, match="disk full"):
        logs.to_csv(tmp_path / "logs")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "logs").mkdir()
    assert_refused(lambda: logs.to_csv(tmp_path / "logs"), "folder", "exists")


WRONG = {
    "one episode without its axis": (lambda: pc.Logs(X[0], U[0], DEPLOYED[0]), "x", "x[None]"),
    "no episode": (lambda: pc.Logs([], [], []), "x", "shape (0,)"),
    "missing value in a state": (lambda: pc.Logs(with_value(X, (2, 3, 0), np.nan), U, DEPLOYED), "x", "[2, 3, 0]"),
    "infinite input": (lambda: pc.Logs(X, with_value(U, (0, 1, 0), np.inf), DEPLOYED), "u", "inf"),
    "text": (lambda: pc.Logs([["a", "b"]], U, DEPLOYED), "x", "real numbers"),
    "complex states": (lambda: pc.Logs(X + 1j, U, DEPLOYED), "x", "complex"),
    "episodes that do not match": (lambda: pc.Logs(X, U[:4], DEPLOYED), "u", "6 episodes"),
    "inputs too short": (lambda: pc.Logs(X, U[:, :3], DEPLOYED), "u[0]", "5 or 6 times"),
    "one state alone": (lambda: pc.Logs(X[:, :1], U[:, :1], DEPLOYED), "x[0]", "transition"),
    "states of two sizes": (lambda: pc.Logs([X[0], X[1][:3, :1]], list(U[:2]), DEPLOYED[:2]), "x[1]", "(time, 2)"),
    "policies of another number": (lambda: pc.Logs(X, U, DEPLOYED[:5]), "deployed", "(6, memory, 1, 2)"),
    "policy without lags": (lambda: pc.Logs(X, U, DEPLOYED[:, 0]), "deployed", "(6, memory, 1, 2)"),
    "policy transposed": (lambda: pc.Logs(X, U, np.swapaxes(DEPLOYED, -1, -2)), "deployed", "swapped"),
    "too few names": (lambda: pc.Logs(X, U, DEPLOYED, ["level"]), "state_names", "2 different names"),
    "one name twice": (lambda: pc.Logs(X, U, DEPLOYED, ["a", "a"]), "state_names", "2 different names"),
    "a name that is no text": (lambda: pc.Logs(X, U, DEPLOYED, None, [3]), "input_names", "1 different names"),
    "a state that is an input": (lambda: pc.Logs(X, U, DEPLOYED, ["a", "b"], ["b"]), "input_names", "which are states"),
    "logs of other signals": (
        lambda: pc.Logs(X, U, DEPLOYED, ["a", "b"]) + pc.Logs(X, U, DEPLOYED, ["b", "a"]),
        "state_names",
        "order of the other",
    ),
    "missing value in a policy": (lambda: pc.Logs(X, U, with_value(DEPLOYED, (0, 0, 0, 0), np.nan)), "deployed", "nan"),
}


@pytest.mark.parametrize("case", WRONG)
def test_logs_refuse_with_one_clear_message(case) -> None:
    build, name, *words = WRONG[case]
    assert_refused(build, name, *words)


def spoil(folder, name: str, old: str, new: str) -> None:
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new, 1))


SPOILED = {
    "missing file": (lambda d: (d / "episode_1.csv").unlink(), "episode_1.csv", "no such file"),
    "no index": (lambda d: (d / "episodes.csv").unlink(), "episodes.csv", "no such file"),
    "header without time": (lambda d: spoil(d, "episode_0.csv", "t,", "time,"), "episode_0.csv", "Add t."),
    "gap in time": (lambda d: spoil(d, "episode_2.csv", "\n2,", "\n7,"), "episode_2.csv", "t = 1 then 7 in line 4"),
    "words in a column": (lambda d: spoil(d, "episode_0.csv", "\n1,", "\none,"), "episode_0.csv", "'one' in line 3"),
    "a cell too many": (lambda d: spoil(d, "episode_0.csv", "\n1,", "\n1,2,"), "episode_0.csv", "5 cells in line 3"),
    "unknown policy": (lambda d: spoil(d, "episodes.csv", "episode_0.csv,0", "episode_0.csv,9"), "episodes.csv", "9"),
    "lag left out": (lambda d: spoil(d, "policies.csv", "\n1,1,", "\n1,2,"), "policies.csv", "lags [2.0] of policy 1"),
    "a signal without its column": (lambda d: spoil(d, "policies.csv", ",x1", ",y"), "episode_0.csv", "Add y."),
    "policies of two shapes": (
        lambda d: (d / "policies.csv").write_text((d / "policies.csv").read_text() + "1,2,u0,0.0,0.0\n"),
        "policies.csv",
        "of one shape",
    ),
    "empty index": (lambda d: (d / "episodes.csv").write_text(""), "episodes.csv", "columns"),
}


@pytest.mark.parametrize("case", SPOILED)
def test_csv_folder_is_refused_with_file_and_line(case, tmp_path) -> None:
    spoiling, name, *words = SPOILED[case]
    pc.Logs(X, U, DEPLOYED).to_csv(tmp_path / "logs")
    spoiling(tmp_path / "logs")
    assert_refused(lambda: pc.Logs.from_csv(tmp_path / "logs"), name, *words)


def test_csv_folder_and_dataset_that_are_none_are_refused(tmp_path) -> None:
    assert_refused(lambda: pc.Logs.from_csv(tmp_path / "nowhere"), "folder", "nowhere")
    dataset = pc.Logs(X, U, DEPLOYED).to_dataset()
    assert_refused(lambda: pc.Logs.from_dataset(dataset.drop_vars("u")), "dataset", "no u")
    assert_refused(lambda: pc.Logs.from_dataset(dataset.rename(time="step")), "dataset", "over")
