"""What the pictures of the network show; trajectories by time are tested with the command line that draws them."""

from __future__ import annotations

import json
import shutil
import subprocess

import pytest
import torch
from matplotlib.collections import EllipseCollection, LineCollection, PathCollection
from matplotlib.quiver import Quiver
from PIL import Image
from tensordict import TensorDict

from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.envs.repair import (
    Graph,
    RepairModel,
    damage_chain,
    grid,
    line,
    network_figure,
    save_animation,
)
from torchrl_pomdp.envs.repair.rendering import animation, network
from torchrl_pomdp.modules import RolloutPolicy
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost
from torchrl_pomdp.trajectories import play

CHAIN, COSTS = damage_chain((0.0, 0.1, 0.2, 0.3)), (0.0, 0.1, 1.0, 10.0, 100.0)


def robots(graph, num_robots=1):
    return RepairModel(graph, CHAIN, COSTS, 0.9, num_robots=num_robots)


def state(model, *location, seed=0):
    belief = torch.rand(model.num_locations, model.num_levels, generator=torch.Generator().manual_seed(seed))
    return TensorDict({"belief": belief / belief.sum(-1, keepdim=True), "location": torch.tensor(location)}, [])


def of_kind(axes, kind):
    return [artist for artist in axes.collections if type(artist) is kind]


def discs(axes):
    """The circles of the locations and the discs of the robots."""
    return of_kind(axes, EllipseCollection)


def texts(axes):
    return [text.get_text() for text in axes.texts]


def offsets(artist):
    """Where the parts of a collection are, ``[N, 2]``."""
    return torch.tensor(artist.get_offsets().tolist())


def spots(axes):
    """Where the discs of the robots are, ``[R, 2]``."""
    return offsets(discs(axes)[1])


def played(model, steps, seed=0):
    start = lambda keys: state(model, *[0] * model.num_robots).expand(keys.shape)  # noqa: E731
    return BeliefEnv(model, start, seed=seed).rollout(steps)


# ---- one state ---------------------------------------------------------------------------------------------------------


def test_locations_are_at_their_places_in_the_colour_of_their_damage():
    model = robots(grid(4, 3))
    y = state(model, 5)
    axes = network_figure(model, y, title="a $ grid").axes[0]
    circles = discs(axes)[0]
    assert circles.get_offsets().tolist() == [[c, r] for r in range(3) for c in range(4)]
    assert circles.get_array().tolist() == pytest.approx((y["belief"] * torch.arange(5)).sum(-1).tolist())
    assert (circles.norm.vmin, circles.norm.vmax, circles.get_cmap().name) == (0, 4, "YlOrRd")
    assert axes.get_ylim()[0] > axes.get_ylim()[1], "rows go down"
    assert axes.get_title() == "a $ grid"
    assert axes.figure.axes[1].get_ylabel() == "expected damage level"


def test_every_edge_is_one_line():
    edges = {(0, 1), (1, 2), (0, 2), (2, 3)}
    model = robots(Graph.from_edges("kite", 4, edges, columns=[0, 0, 1, 2], rows=[0, 2, 1, 1]))
    axes = network_figure(model, state(model, 0)).axes[0]
    drawn = of_kind(axes, LineCollection)[0].get_segments()
    places = list(zip(model.graph.columns.tolist(), model.graph.rows.tolist(), strict=True))
    found = [tuple(sorted(places.index(tuple(end)) for end in segment.tolist())) for segment in drawn]
    assert sorted(found) == sorted(edges)


def test_names_are_in_the_circles_or_below():
    named = {names: robots(Graph.from_slots("pipe", [[1], [0]], ["across"], [0, 1], [0, 0], names)) for names in NAMES}
    for names, model in named.items():
        axes = network_figure(model, state(model, 0)).axes[0]
        assert texts(axes) == [*names, "1"]
        assert {text.get_va() for text in axes.texts[:2]} == {"center_baseline" if names == NAMES[0] else "top"}


NAMES = (("A", "B2"), ("pump $station", "tank"))


def test_names_are_left_out_where_they_would_not_be_legible():
    for locations, count in ((50, 50), (51, 0)):
        model = robots(line(locations))
        figure = network_figure(model, state(model, 0))
        assert len(figure.axes[0].texts) == count + 1
        assert figure.get_size_inches().max() < 13


def test_robots_are_beside_their_locations_and_apart():
    model = robots(grid(3, 3), num_robots=6)
    axes = network_figure(model, state(model, 4, 4, 0, 4, 8, 4)).axes[0]
    assert texts(axes)[-6:] == ["1", "2", "3", "4", "5", "6"]
    where = spots(axes)
    distances = torch.cdist(where, torch.cartesian_prod(torch.arange(3.0), torch.arange(3.0))[:, [1, 0]])
    assert distances.argmin(-1).tolist() == [4, 4, 0, 4, 8, 4]
    width = discs(axes)[1].get_widths()[0]
    assert torch.pdist(where).min() > width
    assert torch.allclose(torch.tensor([text.get_position() for text in axes.texts[-6:]]), where)


def test_sixteen_robots_at_one_location_fit_in_the_picture():
    model = robots(line(3), num_robots=16)
    axes = network_figure(model, state(model, *[0] * 16)).axes[0]
    where, radius = spots(axes), discs(axes)[1].get_widths()[0] / 2
    assert torch.pdist(where).min() > 2 * radius
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    assert left < where[:, 0].min() - radius
    assert where[:, 0].max() + radius < right
    assert top < where[:, 1].min() - radius
    assert where[:, 1].max() + radius < bottom


@pytest.mark.parametrize("control", [("right", "repair", "up"), (2, 0, 3), torch.tensor(2 * 25 + 3), 2 * 25 + 3])
def test_a_control_is_arrows_to_neighbours_and_pluses(control):
    model = robots(grid(3, 3), num_robots=3)
    axes = network_figure(model, state(model, 4, 0, 4), control=control).axes[0]
    (arrows,) = of_kind(axes, Quiver)
    ends = offsets(arrows) + torch.tensor([arrows.U.tolist(), arrows.V.tolist()]).T
    radius = discs(axes)[0].get_widths()[0] / 2
    # From the robots to the circles of what is right of the middle and above it.
    assert torch.allclose(offsets(arrows), spots(axes)[[0, 2]])
    assert (ends - torch.tensor([[2.0, 1.0], [1.0, 0.0]])).norm(dim=-1).numpy() == pytest.approx([radius] * 2, rel=0.2)
    (pluses,) = [offsets(artist) for artist in of_kind(axes, PathCollection) if len(artist.get_offsets())]
    assert pluses.shape == (1, 2)
    assert (pluses[0] - spots(axes)[1]).norm() < 0.3


def test_robots_lean_to_where_they_go_and_keep_right():
    model = robots(grid(3, 3), num_robots=2)
    together = spots(network_figure(model, state(model, 4, 4), control=("left", "right")).axes[0])
    changing = spots(network_figure(model, state(model, 4, 3), control=("left", "right")).axes[0])
    assert together[0, 0] < 1 < together[1, 0]
    # Rows go down: on the way to the left the right hand is up.
    for where in (together, changing):
        assert where[0, 1] < 1 < where[1, 1]


def test_controls_of_many_robots_are_one_for_each():
    model = robots(line(4), num_robots=10)
    action = torch.tensor([2, 1] * 5)
    axes = network_figure(model, state(model, *[1] * 10), control=action).axes[0]
    assert len(of_kind(axes, Quiver)[0].get_offsets()) == 10


def test_a_single_location_can_be_drawn():
    model = robots(Graph.from_slots("alone", [[]], []))
    axes = network_figure(model, state(model, 0), control="repair").axes[0]
    assert discs(axes)[0].get_offsets().tolist() == [[0, 0]]


def test_nothing_is_drawn_of_a_state_or_control_that_is_none():
    model = robots(line(3), num_robots=2)
    y = state(model, 0, 1)
    with pytest.raises(ValueError, match=r"y must be a single feature state, of batch \(\), got batch \(2,\)"):
        network_figure(model, y.expand(2))
    with pytest.raises(ValueError, match=r"control must move robots along edges, got 'left' for robot 1 at 0"):
        network_figure(model, y, control=("left", "right"))
    with pytest.raises(ValueError, match="control must hold one for each of the 2 robots"):
        network_figure(model, y, control=("left",))


# ---- animations --------------------------------------------------------------------------------------------------------


def test_an_animation_has_a_frame_for_every_state(tmp_path):
    model = robots(grid(4, 4), num_robots=2)
    path = tmp_path / "new" / "two.GIF"
    save_animation(path, model, {"short": played(model, 3), "long": played(model, 7)}, frames_per_second=4)
    with Image.open(path) as film:
        assert film.n_frames == 8
        assert film.info["duration"] == 250
        assert film.info["loop"] == 0
        assert film.size[0] > film.size[1]
    assert [each.name for each in path.parent.iterdir()] == ["two.GIF"]
    save_animation(tmp_path / "again.gif", model, {"short": played(model, 3), "long": played(model, 7)}, frames_per_second=4)
    assert (tmp_path / "again.gif").read_bytes() == path.read_bytes()


def test_trajectories_may_show_different_things(tmp_path):
    """The truth of one, the Q-factors of the other."""
    model = robots(line(3))
    true = play(model, GreedyRepair(model), state(model, 0), torch.tensor(7), max_steps=2)
    assert true.get("hidden", None) is not None
    decided = played(model, 2).set("q_factors", torch.zeros(2, 3))
    for trajectories in ({"a": true, "b": decided}, {"b": decided, "a": true}):
        save_animation(tmp_path / "a.gif", model, trajectories)
        assert (tmp_path / "a.gif").is_file()


def test_frames_show_stages_costs_and_controls(monkeypatch):
    model = robots(grid(3, 3), num_robots=2)
    trajectories = {"base": played(model, 2), "rollout": played(model, 4, seed=1)}
    drawn = []
    draw = animation.draw_network
    monkeypatch.setattr(animation, "draw_network", lambda *given: (drawn.append((*given[2:], given[0])), draw(*given)))
    shown = [animation.played(model, *each) for each in trajectories.items()]
    panels = animation._panels(model, shown)[1]
    captions = [[each["belief"].get_xlabel() for each in panels] for _ in animation._frames(model, panels, shown)]
    assert len(captions) == 5
    for number, (name, trajectory) in enumerate(trajectories.items()):
        discounted = -trajectory["next", "reward"].squeeze(-1) * 0.9 ** torch.arange(len(trajectory))
        for frame, (damage, location, controls, title, _) in enumerate(drawn[number::2]):
            stage = min(frame, len(trajectory))
            y = trajectory[stage] if stage < len(trajectory) else trajectory[-1]["next"]
            assert torch.equal(location, y["location"])
            assert torch.allclose(damage, y["belief"] @ torch.arange(5.0))
            assert (controls is None) == (stage == len(trajectory))
            assert controls is None or torch.equal(controls, model.split_controls(y["action"]))
            assert title == name
            caption = captions[frame][number]
            assert caption.startswith(f"stage {stage}, cost so far ")
            assert float(caption.split()[-1]) == pytest.approx(float(discounted[:stage].sum()), rel=1e-3)


def test_the_truth_is_beside_what_is_known_and_bars_are_q_factors():
    model = robots(grid(3, 3))
    policy = RolloutPolicy(model, GreedyRepair(model), trajectories=3, max_steps=5, terminal_cost=NeverRepairCost(model))
    one = play(model, policy, state(model, 4), torch.tensor(7), max_steps=3)
    (each,) = shown = [animation.played(model, "rollout", one)]
    figure, panels = animation._panels(model, shown)
    assert list(panels[0]) == ["belief", "truth", "bars"]
    assert len({axes.get_position().y0 for axes in figure.axes[:3]}) == 1, "of a single trajectory beside each other"
    for stage, _ in enumerate(animation._frames(model, panels, shown)):
        known, truth, bars = panels[0].values()
        after = one[stage] if stage < 3 else one[-1]["next"]
        assert discs(truth)[0].get_array().tolist() == after["hidden", "level"].tolist()
        assert torch.equal(after["hidden", "location"], after["location"])
        here = int(after["location"])
        assert discs(known)[0].get_array()[here] == discs(truth)[0].get_array()[here] or stage == 0, "robots see where they are"
        assert [known.get_xlabel(), truth.get_xlabel()] == ["", ""]
        assert bars.get_xlabel() == each.captions[stage]
        if stage == 3:
            assert not bars.patches
            continue
        q = one["q_factors"][stage]
        legal = q.isfinite().nonzero().flatten().tolist()
        names, values = texts(bars)[::2], [float(text) for text in texts(bars)[1::2]]
        assert names == [model.graph.control_names[u] for u in legal]
        assert values == pytest.approx((q[legal] - q[legal].min()).tolist(), rel=1e-3)
        bold = [text.get_text() for text in bars.texts if text.get_weight() == "bold"]
        assert bold[0] == model.graph.control_names[int(one["action"][stage])]
        assert [bar.get_width() for bar in bars.patches] == pytest.approx([value / max(values) for value in values], rel=1e-3)


def test_several_trajectories_have_the_truth_below(tmp_path):
    model = robots(grid(3, 3))
    greedy = play(model, GreedyRepair(model), state(model, 4), torch.tensor(7), max_steps=2)
    shown = [animation.played(model, "with", greedy), animation.played(model, "without", greedy.exclude("hidden"))]
    figure, panels = animation._panels(model, shown)
    figure.draw_without_rendering()
    first, second = ({kind: axes.get_position() for kind, axes in each.items()} for each in panels)
    assert list(first) == ["belief", "truth"]
    assert list(second) == ["belief"]
    assert first["truth"].y1 < first["belief"].y0
    assert first["belief"].x1 < second["belief"].x0
    wrong = greedy.clone()
    wrong["hidden", "level"][0, 0] = 5
    with pytest.raises(ValueError, match=r"entry 'level' of hidden of trajectories\['a'\] holds values outside its bounds"):
        save_animation(tmp_path / "a.gif", model, {"a": wrong})
    with pytest.raises(ValueError, match=r"q_factors of trajectories\['a'\] must have shape \(2, 5\), got \(2, 4\)"):
        save_animation(tmp_path / "a.gif", model, {"a": greedy.clone().set("q_factors", torch.zeros(2, 4))})


def test_bars_are_for_few_controls():
    model = robots(grid(3, 3), num_robots=3)
    one = play(model, GreedyRepair(model), state(model, 4, 4, 4), torch.tensor(7), max_steps=2)
    assert animation.played(model, "a", one.set("q_factors", torch.zeros(2, 125))).bars is None


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="the program ffmpeg, which writes MP4, is not installed")
def test_a_film_has_the_frames_of_an_animation(tmp_path):
    model = robots(grid(3, 3))
    save_animation(tmp_path / "a.mp4", model, {"a": played(model, 4)}, frames_per_second=2.5)
    assert [each.name for each in tmp_path.iterdir()] == ["a.mp4"]
    asked = "stream=codec_name,pix_fmt,r_frame_rate,nb_frames,width,height"
    command = ["ffprobe", "-v", "error", "-show_entries", asked, "-of", "json", str(tmp_path / "a.mp4")]
    (stream,) = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)["streams"]
    assert (stream["codec_name"], stream["pix_fmt"]) == ("h264", "yuv420p")
    assert (stream["r_frame_rate"], stream["nb_frames"]) == ("5/2", "5")
    assert stream["width"] % 2 == stream["height"] % 2 == 0


def test_a_film_without_ffmpeg_is_refused(tmp_path, monkeypatch):
    model = robots(line(3))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ValueError, match=r"path ends in \.mp4, which needs the program ffmpeg: install it, or name a \.gif"):
        save_animation(tmp_path / "a.mp4", model, {"a": played(model, 2)})
    assert not list(tmp_path.iterdir())


def test_a_trajectory_without_its_last_state_ends_at_its_last_control(tmp_path):
    model = robots(line(3))
    save_animation(tmp_path / "a.gif", model, {"a": played(model, 3).exclude("next")})
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 3


def test_wide_graphs_are_below_each_other(tmp_path):
    model = robots(line(12))
    sizes = []
    for count in (1, 3):
        save_animation(tmp_path / "a.gif", model, {str(i): played(model, 1) for i in range(count)})
        with Image.open(tmp_path / "a.gif") as film:
            sizes.append(film.size)
    assert sizes[0][0] == sizes[1][0]
    assert sizes[0][1] < sizes[1][1]


def test_many_robots_make_small_files(tmp_path):
    model = robots(grid(8, 4), num_robots=10)
    save_animation(tmp_path / "a.gif", model, {"a": played(model, 6), "b": played(model, 6, seed=1)})
    # So that 60 stages are below 2 MB.
    assert (tmp_path / "a.gif").stat().st_size < 200_000


def test_refuses_what_is_no_trajectory_of_the_model(tmp_path):
    model = robots(grid(3, 3))
    good = played(model, 2)
    wrong = {
        "must hold 1 to 12 trajectories, got 0": {},
        "must hold 1 to 12 trajectories, got 13": {str(i): good for i in range(13)},
        r"trajectories\['a'\] must be one trajectory of at least one stage, got batch \(1, 2\)": {"a": good.unsqueeze(0)},
        r"trajectories\['a'\] lacks the entry 'belief'": {"a": good.exclude("belief")},
        r"next of trajectories\['a'\] lacks the entry 'location'": {"a": good.exclude(("next", "location"))},
        r"action of trajectories\['a'\] must be in 0..4, got 5": {"a": good.clone().set("action", torch.tensor([5, 0]))},
        "must move robots along edges, got 'left' for robot 1 at 0": {"a": good.clone().set("action", torch.tensor([1, 0]))},
        "of trajectories.* has shape": {"a": played(robots(line(3)), 2)},
    }
    for message, trajectories in wrong.items():
        with pytest.raises(ValueError, match=message):
            save_animation(tmp_path / "a.gif", model, trajectories)
    with pytest.raises(ValueError, match=r"path must end in \.gif or \.mp4, got "):
        save_animation(tmp_path / "a.png", model, {"a": good})
    assert not list(tmp_path.iterdir())


def test_what_fails_leaves_nothing_behind(tmp_path, monkeypatch):
    model = robots(line(3))
    path = tmp_path / "a.gif"
    path.write_bytes(b"before")
    frame = 0

    def fail_later(*given):
        nonlocal frame
        frame += 1
        if frame > 2:
            raise RuntimeError("no more")

    monkeypatch.setattr(network, "_draw_robots", fail_later)
    with pytest.raises(RuntimeError, match="no more"):
        save_animation(path, model, {"a": played(model, 4)})
    assert [each.name for each in tmp_path.iterdir()] == ["a.gif"]
    assert path.read_bytes() == b"before"
