"""Distillation trains one policy to act as trained ones do."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import tyro

from mtjax.agents import parts
from mtjax.agents.base import BaseAgent, HeadsOfOne, Inputs, Memory
from mtjax.agents.fit import Fit, descend
from mtjax.agents.hyperparameters import FLAT
from mtjax.agents.networks import Params
from mtjax.agents.parts.policies import Categorical, Gaussian, Policy
from mtjax.agents.parts.samplers import Uniform
from mtjax.agents.parts.scaling import NoScaling
from mtjax.agents.state import AgentState, Nets, of_task
from mtjax.agents.teacher import Teacher
from mtjax.experience import Rollouts
from mtjax.types import Acted, Array, InputError, Key, Metrics, Spec, Task, Transition


class Batch(NamedTuple):
    """Holds the data for the loss of one task; for all tasks, leaves are (T, ...)."""

    obs: Any  # (B, O) as the networks take them
    taught: Array  # (B, P) outputs of the teacher's policy, as ``policy`` reads them
    features: Array  # (Z,) or (B, Z) features of the task that need no learned parameters
    mask: Array | None  # (A,) 1 for actions that the task has, else 0; None: it has all


@dataclasses.dataclass(frozen=True)
class Distil(BaseAgent):
    """Distil trains one policy to act as trained ones do (Rusu et al. 2016; Omidshafiei et al. 2017, second phase).

    ``--from`` names the teachers: one run, or several. One run teaches all tasks, and its policy may see which it
    plays. Of several runs each teaches the tasks that it was trained on. A teacher's policy of a task is pi_T, and the
    loss
        L = KL(pi_T(s) | pi(s))
    averaged over the steps of a rollout, then over tasks. With discrete actions pi_T is softmax(z / tau), where z are
    the outputs of a teacher's policy, or the values of all actions of one that learns values, such as pqn, and tau is
    ``teacher_temperature``: 0.01 in Rusu et al., whose teachers are values. With continuous ones both policies are
    Gaussians before the same tanh, and their divergence has a closed form. Rewards are not learned from.

    The policy that learns plays its own rollouts, and its teacher says in each state what it would do (Ross et al.
    2011, "DAgger"). So it learns in the states to which its own mistakes lead. A share of the steps
    (``teacher_share``) is the teacher's, for as long as it does not come far by itself.

    By default it does not see the task (``conditioning=none``). One that remembers finds it out: with
    ``conditioning=recurrent`` as in Omidshafiei et al., or ``inferred``.

    Differs from Rusu et al., where teachers play and their steps are stored: here the learner plays by default, and
    drops its rollouts. Differs from Omidshafiei et al.: there are no other agents in the world, and so no phase in
    which they learn side by side.
    """

    adjustable: ClassVar[tuple[str, ...]] = (
        *(name for name in BaseAgent.adjustable if name not in ("critic_lr", "gamma")),
        *("epochs", "minibatches", "teacher_temperature", "teacher_share"),
    )
    common_presets: ClassVar[bool] = False
    policies: ClassVar[tuple[type[Policy], ...]] = (Gaussian, Categorical)
    devices_differ: ClassVar[bool] = True
    taught: ClassVar[bool] = True
    in_training: ClassVar[Mapping[str, Any]] = MappingProxyType({"teacher": None})
    critic_lr: ClassVar[float] = BaseAgent.critic_lr  # no setting, as the next three: there are no critics
    critic_hidden: ClassVar[tuple[int, ...]] = ()
    critic_heads: ClassVar[HeadsOfOne] = "as-heads"
    critic_layer_norm: ClassVar[bool] = False
    gamma: ClassVar[float] = BaseAgent.gamma  # no setting, as the next: no rewards are learned from
    discounting: ClassVar[Literal["gamma", "horizon"]] = "gamma"
    normalize_observations: bool = True
    """Scale observations to mean 0 and variance 1, by moments of training data alone, and clip them to +-10."""
    max_gradient_norm: float = 1.0
    """Clip the global norm of the gradient to this; 0 does not clip."""
    teacher_temperature: float = 1.0
    """Divide the outputs of teachers' policies of discrete actions by this (tau). Below 1 the learner comes nearer to
    always taking a teacher's likeliest action."""
    teacher_share: float = 0.0
    """Share of the steps in which the teacher acts while rollouts are played."""
    experience: Annotated[Rollouts, FLAT] = dataclasses.field(default_factory=Rollouts)
    teacher: Annotated[Teacher | None, tyro.conf.Suppress] = dataclasses.field(
        default=None, repr=False, metadata=parts.NO_SETTING
    )
    """Whom it learns from. It follows from the runs that --from names."""

    def __post_init__(self):
        super().__post_init__()
        parts.require_positive(self, "teacher_temperature")
        parts.require_shares(self, "teacher_share")
        if self.representation.learns:
            raise InputError("distil has no critics, by which representations learn; use representation=plain")
        if type(self.scaling) is not NoScaling or type(self.sampler) is not Uniform:
            raise InputError("distil learns from no rewards, of all tasks alike: scaling=none and sampler=uniform")

    # Networks.

    def init(self, spec: Spec, tasks: Task, key: Key) -> AgentState:
        """Return the initial state for the training ``tasks`` (T, ...), with the net of the teacher if it has one."""
        state = super().init(spec, tasks, key)
        if self.teacher is None:
            return state
        return state.with_nets(teacher=self.teacher.init(spec, tasks, jax.random.fold_in(key, 2)))

    def init_networks(self, state: AgentState, inputs: Inputs, key: Key) -> AgentState:
        count = self.policy.outputs(len(inputs.action))
        return state.with_nets(actor=self.actor.init(key, state.num_tasks, count, *inputs.actor))

    @property
    def fits(self) -> dict[str, Fit]:
        found = super().fits
        return {"actor": dataclasses.replace(found["actor"], names=("actor", "knowing"), rule=self.gradients)}

    # Acting.

    def act(self, state: AgentState, memory: Memory, obs: Any, task: Task, key: Key | None) -> Acted:
        """Choose an action for one observation (O,) of one task; without a key, the policy's mode."""
        outputs, mask = self.policy_outputs(*self.view.acting(state, memory, obs, task)), task.action_mask
        if self.teacher is None or key is None:
            return Acted(self.policy.draw(outputs, mask, key).action, outputs=outputs)
        taught = self.teacher.act(teaching(state, task), memory.teacher, obs, task).outputs
        own_key, teacher_key, turn_key = jax.random.split(key, 3)
        own, teachers = self.policy.draw(outputs, mask, own_key), self.policy.draw(taught, mask, teacher_key)
        turn = jax.random.uniform(turn_key) < self.teacher_share
        return Acted(jnp.where(turn, teachers.action, own.action), taught, outputs)

    def begin(self, state: AgentState, task: Task) -> Memory:
        memory = super().begin(state, task)
        if self.teacher is None:
            return memory
        return memory._replace(teacher=self.teacher.begin(teaching(state, task), task))

    def remember(self, state: AgentState, memory: Memory, transition: Transition, task: Task) -> Memory:
        after = super().remember(state, memory, transition, task)
        if self.teacher is None:
            return after
        net = teaching(state, task)
        return after._replace(teacher=self.teacher.remember(net, memory.teacher, transition, task))

    # Learning.

    def update(
        self, state: AgentState, window: Transition, tasks: Task, key: Key, number: Array
    ) -> tuple[AgentState, Metrics]:
        """Take a gradient step on windows (T, B, L, ...) of a rollout; metrics are (T,)."""
        if window.extras is None:
            raise InputError("distil learns from trained policies, and has none")
        flat, features, obs, _ = self.view.steps(state, window, tasks)
        batch = self.view.keyed(Batch(obs, flat.extras, features, tasks.action_mask), jax.random.fold_in(key, 1))
        state, fitted = descend(self.fits, "actor", state, self.actor_loss, (batch,), key)
        return state, fitted.aux | fitted.metrics

    def actor_loss(self, nets: Nets, batch: Batch) -> tuple[Array, Metrics]:
        outputs = self.policy_outputs(nets, batch.features, batch.obs)
        discrete = isinstance(self.policy, Categorical)
        taught = batch.taught / self.teacher_temperature if discrete else batch.taught
        loss = jnp.mean(self.policy.divergence(taught, outputs, batch.mask))
        return self.view.join(loss, {"actor_loss": loss}, nets, batch)


def teaching(state: AgentState, task: Task) -> Params:
    """Return the net of the teacher of one task."""
    return of_task({"teacher": state.nets["teacher"]}, state.known(task))["teacher"]
