# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Tutorial 8: your own POMDP
#
# **What you will learn**
#
# 1. to write a small POMDP down as arrays, and to find its optimum as an interval;
# 2. to write a larger one as a belief model of your own, with its hidden world, and to check both;
# 3. to write a base policy of your own, improve it by rollout, and train a network by policy iteration;
# 4. to deploy the result on a stream of observations, with a bad observation refused and a restart in between.
#
# The problem: pumps in the field wear out where nobody sees it. One technician can look at one pump a week, or replace one,
# or stay at home. A worn pump wastes energy, a broken one is expensive.
#
# | word | here | in general |
# |---|---|---|
# | state *i* | how far a pump is worn: new, used, worn, broken | what is hidden |
# | control *u* | wait, inspect, replace | what can be done at a stage; here a stage is a week |
# | observation *z* | what an inspection shows; "nothing" without one | what is seen after the control |
# | belief *b* | a probability for each level of wear | all that is known; entry `"belief"` of the feature state *y* |
# | stage cost *g* | energy, labour and new pumps of a week, in units of 100 € | lower is better; rewards are negative costs |
# | discount | 0.9: a cost counts 10 % less for every week that it is put off | a number in (0, 1) |

# %% tags=["parameters"]
PUMPS = 5
TRAJECTORIES = 20
ROLLOUT_STATES = 300
EVALUATION_STATES = 2000
SAMPLES = 4000
ITERATIONS = 2
OPTIMIZATION_STEPS = 1500
WEEKS = 52

# %%
# %matplotlib inline
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict
from torchrl import logger
from torchrl.data import Bounded, Categorical, Composite

from torchrl_pomdp.controller import Controller
from torchrl_pomdp.envs import BeliefModel, FixedBelief, TabularModel, TrackBelief, World, WorldEnv
from torchrl_pomdp.envs.rows import inverse_cdf
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import RolloutPolicy
from torchrl_pomdp.noise import fold
from torchrl_pomdp.planners import solve
from torchrl_pomdp.problems import Problem, check_belief_model
from torchrl_pomdp.report import Result, cost_figure, table
from torchrl_pomdp.tensor_checks import check_distributions
from torchrl_pomdp.trainers import Checkpoint, PolicyIterationConfig, papi_nt, save_checkpoint

logger.setLevel("WARNING")
plt.rcParams["figure.constrained_layout.use"] = True

# %% [markdown]
# # Part 1: one pump, as arrays
#
# Three arrays are the whole problem. First index: the control; then the level of wear.
#
# - `change[u, i, j]`: the probability that level i becomes level j within the week, under control u;
# - `seen[u, j, z]`: the probability of observation z when the level is j afterwards;
# - `cost[u, i]`: the cost of the week.

# %%
LEVELS, CONTROLS = ("new", "used", "worn", "broken"), ("wait", "inspect", "replace")
OBSERVATIONS = ("nothing", "looks new", "looks used", "looks worn", "is broken")
WAIT, INSPECT, REPLACE = range(3)

wear = torch.tensor([[0.90, 0.10, 0.00, 0.00], [0.00, 0.85, 0.15, 0.00], [0.00, 0.00, 0.80, 0.20], [0.00, 0.00, 0.00, 1.00]])
new_pump = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(4, 4)
change = torch.stack([wear, wear, new_pump])

nothing = torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0]).expand(4, 5)
look = torch.tensor(
    [[0.0, 0.8, 0.2, 0.0, 0.0], [0.0, 0.2, 0.6, 0.2, 0.0], [0.0, 0.0, 0.3, 0.7, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0]]
)
seen = torch.stack([nothing, look, nothing])

waste = torch.tensor([0.0, 1.0, 3.0, 20.0])  # of a week, by level
cost = torch.stack([waste, waste + 1.0, waste + 25.0])

pump = TabularModel(
    change, seen, cost, 0.9, state_names=LEVELS, control_names=CONTROLS, observation_names=OBSERVATIONS
)  # fmt: skip
new = FixedBelief(torch.tensor([1.0, 0.0, 0.0, 0.0]))  # the start: a new pump
print(pump.describe())

# %% [markdown]
# `TabularModel` has checked shapes and that rows sum to one. A wrong array is refused, and the message says what is wrong:

# %%
try:
    TabularModel(change * 1.1, seen, cost, 0.9)
except ValueError as error:
    print(error)

# %% [markdown]
# ## A base policy of your own
#
# A policy is any function that reads a TensorDict of feature states and writes `"action"`. It is given many states at once:
# `y["belief"]` has the shape `[number of states, 4]`. Ours is a rule of thumb: inspect a pump that may be worn, replace it when
# that is likely.


# %%
def rule(y):
    bad = y["belief"][..., 2:].sum(-1)  # probability that it is worn or broken
    action = torch.where(bad > 0.7, REPLACE, torch.where(bad > 0.3, INSPECT, WAIT))
    return y.set("action", action)


# %% [markdown]
# ## The optimum, as an interval
#
# A problem this small can be solved. `solve` gives a lower and an upper bound of the best possible cost, and a policy that
# costs no more than the upper one. That tells how good a rule, or rollout, can be at all.

# %%
solution = solve(pump, new.belief, relative_gap=0.005, seconds=20)
print(f"optimum between {solution.lower:.2f} and {solution.upper:.2f}, found in {solution.seconds:.1f} s")

policies = {
    "rule": rule,
    "rollout of it": RolloutPolicy(pump, rule, trajectories=TRAJECTORIES, max_steps=39),
    "best policy": solution.policy,
}
costs = {name: discounted_costs(pump, policy, new, num_states=ROLLOUT_STATES) for name, policy in policies.items()}
results = [Result(name, compare(each, costs["rule"])) for name, each in costs.items()]
figure = cost_figure(results, "one pump")
figure.axes[0].set_ylabel("discounted cost, 100 €")
figure.axes[0].axhspan(solution.lower, solution.upper, color="#d55e00", alpha=0.6, zorder=3)
figure

# %% [markdown]
# The orange line is the optimum. Nobody can be below it but by luck of the draw: the whiskers, 95 % intervals, say how much
# luck there is. Rollout needs enough trajectories: with 5 instead of 20 it is *worse* than the rule, since the control that
# looks best is then often the one that was lucky.
#
# ## What the policy knows, and what is true
#
# `WorldEnv` has the true wear inside and shows observations only. `TrackBelief` turns observations into beliefs. So a picture
# can have both: the colours are the belief, the line is the truth that the policy never sees.

# %%
SHADES = ("#ffffff", "#c6dbef", "#6baed6", "#08306b")  # from new to broken, darker and darker
MARKS = {INSPECT: ("o", "#e69f00", "inspect"), REPLACE: ("^", "#d55e00", "replace")}


def draw_pump(axes, belief, level, kind):
    """Belief [T, 4] as stacked areas, true level [T] as a line, and the control of each week [T] as a mark."""
    weeks = range(len(belief))
    axes.stackplot(weeks, belief.T.numpy(), colors=SHADES, edgecolor="#bbbbbb", linewidth=0.3)
    truth = axes.twinx()
    truth.step(weeks, level.numpy(), where="mid", color="black", linewidth=1.4)
    truth.set(ylim=(-0.3, 3.9), yticks=range(4), yticklabels=LEVELS)
    for control, (marker, colour, _) in MARKS.items():
        on = (kind == control).nonzero().flatten().numpy()
        truth.scatter(on, [3.6] * len(on), marker=marker, color=colour, s=26, zorder=5)
    axes.set(xlim=(0, len(belief) - 1), ylim=(0, 1), yticks=(0, 0.5, 1))


def legend(figure):
    handles = [plt.Rectangle((0, 0), 1, 1, facecolor=shade, edgecolor="#bbbbbb") for shade in SHADES]
    handles += [plt.Line2D([], [], color="black")]
    handles += [plt.Line2D([], [], color=colour, marker=marker, linestyle="") for marker, colour, _ in MARKS.values()]
    names = [*(f"P({level})" for level in LEVELS), "true wear", *(name for *_, name in MARKS.values())]
    figure.legend(handles, names, loc="outside upper center", ncols=4, fontsize="small")


def play(model, start, policy, seed):
    """WEEKS weeks of a policy: feature states and controls [WEEKS], and the hidden states behind them."""
    env = WorldEnv(model, start, seed=seed).append_transform(TrackBelief(model))
    y, weeks, truth = env.reset(), [], []
    for _ in range(WEEKS):
        truth.append(env.base_env.hidden)
        with torch.no_grad():
            y = policy(y.unsqueeze(0))[0]
        weeks.append(y.clone())
        y = env.step_mdp(env.step(y))
    return torch.stack(weeks), torch.stack(truth)


weeks, truth = play(pump, new, policies["rollout of it"], seed=3)
figure, axes = plt.subplots(figsize=(8, 3))
draw_pump(axes, weeks["belief"], truth["state"], weeks["action"])
axes.set(xlabel="week", ylabel="probability")
legend(figure)
plt.show()

# %% [markdown]
# # Part 2: many pumps, as a belief model of your own
#
# Five pumps have 4⁵ = 1024 joint states, twenty have 10¹². Arrays are out of the question. But pumps wear independently, and
# an inspection tells of one pump only. So the belief is one small distribution for each pump, `[*B, n, 4]`: exact, and cheap.
#
# A belief model is a handful of *batched* functions of the feature state. `*B` is any batch shape; you never loop over it.
#
# | method | the question it answers |
# |---|---|
# | `state_spec` | what is in a feature state |
# | `action_mask` | which controls are legal |
# | `expected_cost` | what does a control cost this week, on average under the belief |
# | `observation_probs` | how likely is each observation |
# | `estimator` | what is the next belief, given the observation (Bayes' rule) |
# | `world` | what hides behind it, for simulations of the real thing; may be left out |
#
# Here control 0 is to wait, controls 1 and 2 inspect and replace the first pump, 3 and 4 the second, and so on. For every pump
# the arrays of Part 1 apply: those of the control for the pump that is visited, those of waiting for the others.
#
# Three small functions of the library appear below. `sum_first` adds over the first dimension, in an order that does not depend
# on the batch, so that results are the same to the last bit however they are computed; it overwrites what it is given, hence the
# clone. (`.sum()` works too, without that promise.) `inverse_cdf(probs, noise)` draws from probabilities with a uniform random
# number. `fold(keys, week)` makes other random numbers for every week.


# %%
class Pumps(BeliefModel):
    """n pumps that wear independently; a technician visits one of them a week, or none."""

    state_keys = ("belief",)
    observation_names = OBSERVATIONS

    def __init__(self, num_pumps, discount=0.9):
        super().__init__(discount)
        self.num_pumps, self.num_controls, self.num_observations = num_pumps, 1 + 2 * num_pumps, len(OBSERVATIONS)
        self.control_names = ("wait", *(f"{verb} {p + 1}" for p in range(num_pumps) for verb in ("inspect", "replace")))
        self.max_cost = num_pumps * float(waste.max()) + 25.0
        # By joint control: the pump that is visited, and what is done with each pump.
        visited = (torch.arange(self.num_controls) - 1).clamp_min(0) // 2
        kinds = torch.full((self.num_controls, num_pumps), WAIT)
        for u in range(1, self.num_controls):
            kinds[u, visited[u]] = INSPECT if u % 2 else REPLACE
        tables = {"change": change, "seen": seen, "cost": cost, "visited": visited, "kinds": kinds}
        for name, tensor in tables.items():
            self.register_buffer(name, tensor, persistent=False)

    @property
    def device(self):
        return self.change.device

    @property
    def dtype(self):
        return self.change.dtype

    def state_spec(self, batch_size=()):
        shape = (*batch_size, self.num_pumps, len(LEVELS))
        belief = Bounded(0.0, 1.0, shape=shape, dtype=self.dtype, device=self.device)
        return Composite(belief=belief, shape=torch.Size(batch_size), device=self.device)

    def check_state(self, y):
        super().check_state(y)
        check_distributions("entry 'belief' of y", y["belief"])

    def action_mask(self, y):
        return torch.ones(*y.batch_size, self.num_controls, dtype=torch.bool, device=self.device)

    def expected_cost(self, y, u):
        terms = y["belief"] * self.cost[self.kinds[u]]  # [*B, n, 4]
        return sum_first(terms.flatten(-2).movedim(-1, 0))

    def observation_probs(self, y, u):
        _, _, joint = self._afterwards(y, u)
        return sum_first(joint.movedim(-2, 0))

    def estimator(self, y, u, z):
        self.check_controls(y, u)
        self.check_observations(y, z)
        belief, pump, joint = self._afterwards(y, u)
        weight = joint.gather(-1, z[..., None, None].expand(*z.shape, len(LEVELS), 1)).squeeze(-1)  # [*B, 4]
        total = sum_first(weight.movedim(-1, 0).clone())
        self.refuse_impossible(z, total > 0)
        return self.successor(y, belief=belief.scatter(-2, pump, (weight / total.unsqueeze(-1)).unsqueeze(-2)))

    def _afterwards(self, y, u):
        """Belief [*B, n, 4] before the observation; where the visited pump is in it; its P(level, observation) [*B, 4, 5]."""
        kinds, visited = self.kinds[u], self.visited[u]
        belief = sum_first((y["belief"].unsqueeze(-1) * self.change[kinds]).movedim(-2, 0))
        pump = visited[..., None, None].expand(*u.shape, 1, len(LEVELS))
        kind = kinds.gather(-1, visited.unsqueeze(-1)).squeeze(-1)
        return belief, pump, belief.gather(-2, pump).movedim(-1, -2) * self.seen[kind]

    def world(self):
        return PumpsWorld(self)


class PumpsWorld(World):
    """The true wear of each pump."""

    def __init__(self, model):
        super().__init__(model)
        # Uniform random numbers: to draw a hidden state; for a week, the wear of each pump and what an inspection shows.
        self.draw_dim, self.noise_dim = model.num_pumps, model.num_pumps + 1

    def hidden_spec(self, batch_size=()):
        level = Categorical(len(LEVELS), shape=(*batch_size, self.model.num_pumps), dtype=torch.int64)
        return Composite(level=level, shape=torch.Size(batch_size))

    def action_mask(self, hidden):
        return self.model.action_mask(hidden)

    def is_terminal(self, hidden):
        return torch.zeros(hidden.batch_size, dtype=torch.bool)

    def draw(self, y, noise):
        return TensorDict({"level": inverse_cdf(y["belief"], noise)}, y.batch_size)

    def advance(self, hidden, u, noise):
        model, level = self.model, hidden["level"]
        kinds, visited = model.kinds[u], model.visited[u].unsqueeze(-1)
        after = inverse_cdf(model.change[kinds, level], noise[..., :-1])
        look = model.seen[kinds.gather(-1, visited), after.gather(-1, visited)].squeeze(-2)
        z = inverse_cdf(look, noise[..., -1])
        return model.cost[kinds, level].sum(-1), TensorDict({"level": after}, hidden.batch_size), z


def all_new(keys):
    """Start states: every pump is new. Keys are numbers that random start states would be made from."""
    belief = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(*keys.shape, PUMPS, 4).clone()
    return TensorDict({"belief": belief}, keys.shape)


pumps = Pumps(PUMPS)
print(pumps.describe())

# %% [markdown]
# ## Check the model
#
# `check_belief_model` plays at random and holds every method against the others: shapes for any batch, probabilities that sum
# to one, successors that come as often as the probabilities say, names, bounds. It returns nothing when all is well.

# %%
check_belief_model(pumps, all_new)

# %% [markdown]
# When something is wrong it names the method, the rule, what it found, and how to mend it. Here are two slips that are easily
# made: a sum over the whole batch, and Bayes' rule without the division.


# %%
class Careless(Pumps):
    def expected_cost(self, y, u):
        return (y["belief"] * self.cost[self.kinds[u]]).sum()


class Undivided(Pumps):
    def estimator(self, y, u, z):
        belief, pump, joint = self._afterwards(y, u)
        weight = joint.gather(-1, z[..., None, None].expand(*z.shape, len(LEVELS), 1)).squeeze(-1)
        return self.successor(y, belief=belief.scatter(-2, pump, weight.unsqueeze(-2)))


for wrong in (Careless, Undivided):
    try:
        check_belief_model(wrong(PUMPS), all_new)
        print(wrong.__name__, "is fine")
    except (AssertionError, ValueError) as error:
        print(f"{wrong.__name__}: {error}\n")

# %% [markdown]
# A checker cannot know what you *meant*. Two more checks can. First, the smallest case against the arrays of Part 1: one pump.

# %%
single = Pumps(1)
belief = torch.rand(200, 4, generator=torch.Generator().manual_seed(0))
belief /= belief.sum(-1, keepdim=True)
one, arrays = TensorDict({"belief": belief.unsqueeze(1)}, [200]), TensorDict({"belief": belief}, [200])
z = torch.full((200,), OBSERVATIONS.index("looks worn"))
for control in range(3):
    u = torch.full((200,), control)
    torch.testing.assert_close(single.expected_cost(one, u), pump.expected_cost(arrays, u))
    torch.testing.assert_close(single.observation_probs(one, u), pump.observation_probs(arrays, u))
u = torch.full((200,), INSPECT)
torch.testing.assert_close(single.estimator(one, u, z)["belief"][:, 0], pump.estimator(arrays, u, z)["belief"])
print("one pump: the model and the arrays agree")

# %% [markdown]
# Second, the world against the model. If both are right, then among all pumps of which the belief says "worn with probability
# 0.3", three in ten are worn. Thousands of pumps, random controls for 30 weeks:

# %%
keys = torch.arange(2000)
world, y = pumps.world(), pumps.with_features(all_new(keys))
hidden = world.sample(y, keys)
generator = torch.Generator().manual_seed(0)
for week in range(30):
    u = torch.randint(pumps.num_controls, keys.shape, generator=generator)
    _, hidden, z = world.step(hidden, u, fold(keys, week))
    y = pumps.estimator(y, u, z)

figure, axes = plt.subplots(figsize=(4.2, 4))
edges = torch.linspace(0, 1, 11)
far = 0.0
for level, marker, colour in zip(range(1, 4), "os^", ("#0072b2", "#e69f00", "#009e73"), strict=True):
    says, true = y["belief"][..., level].flatten().clone(), (hidden["level"] == level).flatten().float()
    which = torch.bucketize(says, edges[1:-1])
    full = [own for own in range(10) if (which == own).sum() >= 300]
    x, share = ([float(values[which == own].mean()) for own in full] for values in (says, true))
    far = max(far, *(abs(a - b) for a, b in zip(x, share, strict=True)))
    axes.plot(x, share, marker, color=colour, label=LEVELS[level])
axes.plot([0, 1], [0, 1], color="#999999", linewidth=1)
axes.set(xlabel="probability under the belief", ylabel="share of pumps for which it is true", aspect="equal")
axes.legend(title="level of wear")
plt.show()
print(f"largest distance from the diagonal: {far:.3f}")

# %% [markdown]
# # Part 3: train it
#
# The rule of thumb for many pumps: care for the worst one. A `Problem` puts model, start states and base policies together;
# everything else that training needs has a default.


# %%
def worst_first(y):
    bad = y["belief"][..., 2:].sum(-1)  # [*B, n]
    worst = bad.max(-1)
    kind = torch.where(worst.values > 0.7, 2, 1)
    return y.set("action", torch.where(worst.values > 0.3, 2 * worst.indices + kind, 0))


problem = Problem(pumps, all_new, name="pumps", base_policies={"worst first": worst_first})

# %% [markdown]
# `papi_nt` is the paper's policy iteration. Each iteration labels states with the control that rollout of the last policy
# finds, teaches a network to imitate them, and compares the network with the best policy so far, on the same start states and
# the same noise. It is accepted only where it is better with 95 % confidence. (With `progress=True` bars show how far it is.)

# %%
config = PolicyIterationConfig(
    iterations=ITERATIONS,
    samples_per_part=SAMPLES,
    least_steps=OPTIMIZATION_STEPS,
    validation_states=EVALUATION_STATES,
)
training = papi_nt(problem, config, problem.base_policies["worst first"])
iterations = []
for iteration in training:
    iterations.append(iteration)
    print(f"iteration {iteration.number}: {iteration.reason}")
trained = training.best

# %%
policies = {"worst first": worst_first} | {f"network {each.number}": each.policy for each in iterations}
model = problem.model  # the same as `pumps`, with a partition of a single part, which the networks read
costs = {name: discounted_costs(model, policy, all_new, num_states=EVALUATION_STATES) for name, policy in policies.items()}
results = [Result(name, compare(each, costs["worst first"])) for name, each in costs.items()]
print(table(results))
figure = cost_figure(results, f"{PUMPS} pumps")
figure.axes[0].set_ylabel("discounted cost, 100 €")
figure.axes[0].axhline(PUMPS * solution.lower, color="#d55e00")
figure

# %% [markdown]
# The orange line is a bound that comes for free: with a technician for each pump the cost would be that of so many single
# pumps, and one technician can do no better than many. It says how much there is to gain at most. Where networks are not better
# than a rule, look at this first: compare the rule with a bound, or with its rollout from a hundred start states. If rollout
# with many trajectories gains nothing, a network that imitates it will not either.
#
# The same from the command line: put the code into a file `pumps.py`, with `problem` made by a function
# `def make(): return Problem(...)`, and then
#
#     torchrl-pomdp train pumps:make --samples-per-part 6000 --out runs/pumps
#
# which keeps every result as soon as it is there, and goes on where it was when it is interrupted. It also evaluates online
# rollout of the rule. That takes long for a belief model of your own, which tensors simulate: `--rollout-states 50` makes it
# short. Name the problem again to use what the run has made, as a file cannot describe your code:
#
#     torchrl-pomdp report runs/pumps --problem pumps:make
#     torchrl-pomdp evaluate runs/pumps/best.pt --problem pumps:make
#
# # Part 4: deploy it
#
# A trained policy is a file of tensors and JSON. No code is ever run because a file says so; a problem of your own is therefore
# given back when the file is loaded. A `Controller` keeps the belief of one real system: `act` says what to do, `update` takes
# in what was done and what was seen.

# %%
folder = Path(tempfile.mkdtemp())
best = max([iteration.number for iteration in iterations if iteration.accepted], default=0)  # 0: the base policy
save_checkpoint(folder / "pumps.pt", Checkpoint(problem, config, "pAPI-NT", best, trained, iterations[-1].value))
controller = Controller.from_checkpoint(folder / "pumps.pt", problem=problem)
controller.reset(all_new(torch.tensor(0)))
print("first control:", controller.act().names)

# %% [markdown]
# Real observations come one by one, and some are wrong. What is impossible is refused, with a message, and changes nothing: the
# controller goes on as if the bad message had not come.

# %%
before = controller.to_json()
for control, observation in [("inspect 2", "nothing"), ("inspect 2", "looks blue"), ("wait", "looks worn"), ("inspect 9", 1)]:
    try:
        controller.update(control, observation)
    except ValueError as error:
        print(f"{control}, {observation}: {error}")
print("state unchanged:", controller.to_json() == before)

# %% [markdown]
# Now the stream. In the field the observation is what the technician reports; here the world plays the pumps. Half-way the
# computer is switched off: the state is in a file, and another controller goes on from it.

# %%
hidden, keys = world.sample(all_new(torch.arange(1)), torch.arange(1)), torch.arange(1) + 77
beliefs, levels, done = [], [], []
for week in range(WEEKS):
    if week == WEEKS // 2:
        (folder / "state.json").write_text(controller.to_json())
        controller = Controller.from_checkpoint(folder / "pumps.pt", problem=problem)
        controller.load_json((folder / "state.json").read_text())
        print(f"week {week}: restarted, {controller.steps} controls are behind us")
    beliefs.append(controller.state["belief"])
    levels.append(hidden["level"][0])
    decision = controller.act()
    _, hidden, z = world.step(hidden, torch.tensor([decision.control]), fold(keys, week))  # the real pumps
    controller.update(decision.control, OBSERVATIONS[int(z)])
    done.append(pumps.kinds[decision.control])

figure, panels = plt.subplots(PUMPS, 1, figsize=(8, 1.25 * PUMPS + 0.8), sharex=True, squeeze=False)
for number, (axes,) in enumerate(panels):
    belief, level, kind = (torch.stack(each)[:, number] for each in (beliefs, levels, done))
    draw_pump(axes, belief, level, kind)
    axes.set_ylabel(f"pump {number + 1}\nprobability", fontsize="small")
axes.set_xlabel("week")
legend(figure)
plt.show()

# %% [markdown]
# # Where to go on
#
# - **Your problem.** Up to some thousand states: arrays, dense or sparse (`TabularModel`), or a file `.POMDP` (`read_pomdp`).
#   More: find what makes the belief small, as the independence of the pumps did here, and write a belief model.
# - **Illegal controls**: return them as False from `action_mask`; nobody will ever choose them.
# - **An end**: override `is_terminal`.
# - **A better network input**: an `Encoder` of your own, given to `Problem` as `encoder`. **Several networks**: a
#   `FunctionPartition` given to `BeliefModel.__init__`.
# - **Many technicians**: joint controls grow too many to be enumerated; tutorial 6 lets one decide after the other.
# - **More computers**: tutorial 7. **Tree searches and PPO beside it**: tutorial 5.
