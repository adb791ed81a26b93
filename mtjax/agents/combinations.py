"""Settings and parts of an agent that cannot be used, or not together. An InputError says why."""

from typing import Any

import jax

from mtjax import frames
from mtjax.agents import parts
from mtjax.agents.hyperparameters import PARTS
from mtjax.agents.networks import Trunk
from mtjax.agents.parts.gradients.surgery import Rule
from mtjax.agents.parts.policies import policy_for
from mtjax.types import InputError, Spec


def check(agent: Any) -> None:
    """Check the numbers and parts of any agent."""
    parts.require_positive(agent, "actor_lr", "critic_lr")
    if not agent.max_gradient_norm >= 0:
        raise InputError(f"max-gradient-norm must be at least 0 (0 does not clip), not {agent.max_gradient_norm}")
    parts.require_not_negative(agent, "weight_decay", "lr_warmup", "lr_updates")
    parts.require_layers(agent, "hidden")
    parts.require_widths(agent, "actor_hidden", "critic_hidden")
    parts.require_shares(agent, "gamma", "lr_final")
    _check_knowing(agent)
    _check_encoder(agent)
    _check_gradients(agent)
    _check_scaling(agent)
    _check_schedule(agent)
    if agent.plasticity.every:
        _check_units(agent)
    if agent.continual.keeps:
        _check_continual(agent)


def heads(agent: Any, network: str) -> str:
    """Return what each task has for itself of an agent's actor or critics: shared, per-task or disjoint."""
    given = getattr(agent, f"{network}_heads")
    return agent.heads if given == "as-heads" else given


def disjoint(agent: Any) -> bool:
    """Return whether tasks share neither actor nor critics."""
    return heads(agent, "actor") == heads(agent, "critic") == "disjoint"


def require_heads(agent: Any, needed: str, reason: str) -> None:
    """Require what each task has for itself of both actor and critics.

    Raises:
        InputError: it is not ``needed``, for this reason.
    """
    for network in ("actor", "critic"):
        if heads(agent, network) != needed:
            name = "heads" if getattr(agent, f"{network}_heads") == "as-heads" else f"{network}-heads"
            raise InputError(f"{reason}: {name} is {needed}, not {heads(agent, network)}")


def _name(agent: Any, kind: str) -> str:
    return parts.name_of(PARTS[kind], getattr(agent, kind))


def _check_knowing(agent: Any) -> None:
    conditioning, representation = agent.conditioning, agent.representation
    reason = conditioning.refuses()
    if reason:
        raise InputError(reason)
    if agent.tune == "embedding" and not (conditioning.embeds or representation.embeds):
        raise InputError(f"tune=embedding needs conditioning=embedding, not {_name(agent, 'conditioning')}")
    lengths = conditioning.history, representation.history
    if all(lengths) and len(set(lengths)) > 1:
        raise InputError(
            f"inferred-from={lengths[0]} and theta-from={lengths[1]} are numbers of the same last steps; give both "
            "one value"
        )
    if conditioning.recurs and representation.history:
        name = _name(agent, "conditioning")
        raise InputError(f"conditioning={name} and theta-from are two memories of an episode; use one of them")
    if conditioning.recurs and conditioning.burn_in and not agent.experience.storage.kept:
        raise InputError(
            f"burn-in={conditioning.burn_in} renews memories that a replay has stored, and {type(agent).__name__} "
            "learns from rollouts; use burn-in=0, or sac"
        )


def _check_encoder(agent: Any) -> None:
    encoder, name = agent.encoder, _name(agent, "encoder")
    reason = encoder.refuses(agent.conditioning, agent.representation.embeds)
    if reason:
        raise InputError(f"{name} {reason}")
    if encoder.has_statistics and not agent.fits_statistics:
        raise InputError(f"{name} needs an agent that keeps running statistics, such as xqc; use another encoder")
    if agent.representation.sees_pictures and encoder.front() is not None:
        raise InputError(
            f"{name} maps observations, and with representation={_name(agent, 'representation')} networks see a latent "
            "state; choose another encoder"
        )
    for hidden in (agent.actor_hidden or agent.hidden, agent.critic_hidden or agent.hidden):
        encoder.body(hidden, layer_norm=False)  # which refuses widths that it cannot take


def _check_gradients(agent: Any) -> None:
    rule = _name(agent, "gradients")
    for network in ("actor", "critic"):
        if heads(agent, network) == "disjoint" and type(agent.gradients) is not Rule:
            name = "heads" if disjoint(agent) else f"{network}-heads"
            raise InputError(f"{name}=disjoint leaves no parameters that tasks share for gradients={rule}; use mean")
    if agent.gradient_scope == "per-layer" and agent.gradients.needs != "gradients":
        raise InputError(f"gradient-scope=per-layer needs gradients of every task, which {rule} does not use")


def _check_scaling(agent: Any) -> None:
    scaling = _name(agent, "scaling")
    if agent.scaling.discounted and agent.gamma == 1:
        raise InputError(f"scaling={scaling} needs discounted returns, which have bounds; use gamma below 1")
    if agent.scaling.follows_resets and not agent.experience.reset_every:
        raise InputError(
            f"scaling={scaling} renews its factors where networks are reset, and here none are; use scaling=reward, "
            "or give reset-every to an agent that has a replay"
        )


def _check_schedule(agent: Any) -> None:
    shape = agent.lr_schedule
    if shape == "constant" and (agent.lr_final or agent.lr_updates):
        given = f"lr-final={agent.lr_final}" if agent.lr_final else f"lr-updates={agent.lr_updates}"
        raise InputError(f"{given} is where a schedule ends, and lr-schedule=constant is none; use linear or cosine")
    restarts = {
        "reset-every": agent.experience.reset_every,
        "reset-optimizer": agent.continual.reset_optimizer,
        f"continual={_name(agent, 'continual')}": agent.continual.restarts,
    }
    cause = next((name for name, present in restarts.items() if present), "")
    if shape != "constant" and cause:
        raise InputError(f"{cause} begins the optimisers anew, and lr-schedule={shape} with them; use constant")


def _check_units(agent: Any) -> None:
    """Refuse to renew units of networks that are no plain MLPs of all tasks."""
    renews = f"plasticity={_name(agent, 'plasticity')} renews the units of plain MLPs that all tasks share"
    plain = type(agent.encoder.body(agent.hidden, layer_norm=False)) is Trunk and not agent.encoder.front()
    otherwise = agent.representation.learns or agent.fits_statistics or agent.distils
    if not plain or otherwise or agent.unit_head or agent.tune != "all":
        raise InputError(
            f"{renews}: it needs encoder=identity, representation=plain, unit-head=false and tune=all, in sac or ppo"
        )
    # Heads of tasks that a curriculum does not play would keep their weights out of a unit that begins anew.
    require_heads(agent, "shared", renews)
    if agent.critic.own:
        raise InputError(f"{renews}, and value-normalization=popart gives each a head of its critic; use running")


def check_replayed(agent: Any) -> None:
    """Check the numbers and parts of an agent that learns soft actor-critic from a replay."""
    parts.require_rates(agent, "tau")
    parts.require_positive(agent, "temperature_lr", "num_critics", "initial_temperature")
    if not 0 <= agent.temperature_momentum < 1:
        raise InputError(f"temperature-momentum must be in [0, 1), not {agent.temperature_momentum}")
    scaling, replay, own = _name(agent, "scaling"), agent.experience, heads(agent, "critic")
    if agent.scaling.rescales and (own == "shared" or not agent.value.linear):
        raise InputError(
            f"scaling={scaling} rescales a scalar head of every task's own; use value=scalar and heads=per-task or "
            f"disjoint, not {_name(agent, 'value')} and {own}"
        )
    if agent.scaling.rescales and agent.unit_head:
        raise InputError(f"scaling={scaling} rescales heads, which unit-head keeps at length 1; use one of them")
    if agent.representation.predicts and replay.n_step > 1:
        name = _name(agent, "representation")
        raise InputError(f"{name} learns models of single steps; use n-step=1, not {replay.n_step}")
    recurs, burn_in = agent.conditioning.recurs, agent.conditioning.burn_in
    if agent.unroll and (replay.n_step > 1 or replay.hindsight or replay.host_replay_size):
        kind = "conditioning" if recurs else "target"
        raise InputError(f"{kind}={_name(agent, kind)} needs n-step=1, hindsight=0 and host-replay-size=0")
    if agent.unroll > replay.warmup_steps + 1:
        steps = f"{'recurrent' if recurs else 'retrace'}-steps={agent.unroll - burn_in}"
        front = f" after burn-in={burn_in}" if burn_in else ""
        raise InputError(
            f"{steps}{front} needs as many steps before the first update: "
            f"warmup-steps of at least {agent.unroll - 1}, not {replay.warmup_steps}"
        )


def refuse_of_replay(agent: Any) -> None:
    """Refuse settings of a representation that only learning from a replay has."""
    given, usual = (parts.settings(x) for x in (agent.representation, type(agent.representation)()))
    for name in ("encoder_tau", "shift"):
        if given.get(name) != usual.get(name):
            flag, kind = name.replace("_", "-"), type(agent).__name__.lower()
            raise InputError(f"{flag}={given[name]} is of updates from a replay, and {kind} has none; leave it out")


def _check_continual(agent: Any) -> None:
    """Refuse what would change the actor of earlier tasks beside its gradient steps, or leaves nothing to hold."""
    name = _name(agent, "continual")
    if heads(agent, "actor") == "disjoint":
        raise InputError(f"continual={name} holds what tasks share, and heads=disjoint shares nothing; use per-task")
    rollouts = "" if agent.experience.storage.kept else f"{type(agent).__name__} has rollouts"
    if rollouts and agent.continual.freezes:
        raise InputError(
            f"continual={name} learns on from a replay, and {rollouts}; use sac, or another way to remember"
        )
    if rollouts and agent.conditioning.recurs:
        raise InputError(f"continual={name} holds no policy with a memory where {rollouts}; use another conditioning")
    if agent.fits_statistics or agent.distils:
        raise InputError(
            f"continual={name} holds one actor without statistics, as sac has; not {type(agent).__name__}'s"
        )
    if not agent.continual.freezes:
        return
    if agent.plasticity.every or agent.plasticity.changes:
        changes = f"plasticity={_name(agent, 'plasticity')}"
        raise InputError(f"{changes} changes the weights that continual={name} keeps as they are; use one of them")
    knows, sees = agent.conditioning, agent.representation
    changing = {
        "normalize-observations": (agent.normalize_observations, "normalize-observations=false"),
        "unit-head": (agent.unit_head, "unit-head=false"),
        f"representation={_name(agent, 'representation')}": (sees.learns, "representation=plain"),
        f"conditioning={_name(agent, 'conditioning')}": (
            knows.embeds or knows.recurs or knows.history,
            "conditioning=one-hot",
        ),
    }
    for setting, (present, instead) in changing.items():
        if present:
            raise InputError(
                f"continual={name} keeps the actor of earlier tasks as it is, which {setting} changes; use "
                f"--agent.{instead}"
            )


# What an agent and a family need of each other.


def require_sight(agent: Any, spec: Spec) -> None:
    """Check that networks and representation can take a family's observations.

    Raises:
        InputError: they cannot, or tasks would have to be inferred from pictures.
    """
    if not frames.numeric(spec.obs):
        told = jax.tree.map(lambda x: f"{x.dtype}{list(x.shape)}" if hasattr(x, "dtype") else repr(x), spec.obs)
        raise InputError(f"{type(agent).__name__} takes {agent.takes}; not {told}")
    if agent.follows_sketches and not spec.symbols:
        raise InputError("this agent plays families that follow a sketch, such as --env=craft-sketched")
    agent.representation.require(frames.joined(spec.obs))
    if agent.view.history and frames.layout(spec.obs) and agent.experience.hindsight:
        raise InputError(
            "hindsight relabels last steps that are vectors of floats as the family observes them, and "
            "these are joined of other arrays; use --hindsight=0, or another conditioning"
        )
    if frames.shown(spec.obs) and agent.view.history:
        raise InputError("tasks cannot be inferred from pictures; choose another conditioning")
    if frames.shown(spec.obs) and agent.target.window:
        raise InputError(f"target={_name(agent, 'target')} sums over windows of vectors, not pictures; use target=td")
    if frames.shown(spec.obs) and agent.conditioning.recurs:
        name = _name(agent, "conditioning")
        raise InputError(f"conditioning={name} reads vectors, not pictures; choose another conditioning")


def require_policy(agent: Any, spec: Spec) -> None:
    """Check that an agent was made for a family's actions, and can learn to draw them.

    Raises:
        InputError: it was not, or cannot.
    """
    policy, kind, name = policy_for(spec.action), spec.action.kind, type(agent).__name__
    if not isinstance(policy, agent.policies):
        raise InputError(f"{name} draws no {kind} actions")
    if agent.policy != policy:
        raise InputError(f"{name} was not made for these {kind} actions: for_action(agent, env.spec.action) is")
