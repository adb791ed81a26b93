"""A belief about a hidden task, which is inferred from the steps of a trial and learns by losses of its own."""

import dataclasses
from typing import Any, ClassVar, Literal

import jax

from mtjax.agents import parts
from mtjax.agents.networks import Params, init_params
from mtjax.agents.parts.knowing.inference import INFERENCES, Inference
from mtjax.agents.parts.knowing.recurrent import Remembering
from mtjax.types import Array, Key, Metrics


@dataclasses.dataclass(frozen=True)
class Posterior(Remembering):
    """Shows networks what is believed of a hidden task, given the steps of the trial so far.

    A step is (s, a, r, s'), with e = 1 if an episode ended with it; then s' is the start of another, and unknown to all
    below. A belief q is a Gaussian over latent tasks z, of which networks see mean and log-variance.

    ``varibad`` (Zintgraf et al. 2020): a recurrent unit reads the steps, and its state gives q:
        h_(t+1) = GRU(h_t, [s_t, a_t, r_t, s'_t - s_t, e_t]),  q_t = N(W h_t, exp(V h_t)),  h_0 = 0, so q_0 = N(0, 1)
    From one z ~ q_(t+1), models predict rewards and states of D steps j of the trial's n, from before and after t:
        L = mean_j ((R(s_j, a_j, s'_j, z) - r_j)^2 + c mean_d (S(s_j, a_j, z) - (s'_j - s_j))^2)
            + beta KL(q_(t+1) | q_t) / n
    ``pearl`` (Rakelly et al. 2019): every step is read by itself, in any order, as a Gaussian, and q is their product:
        q_t = N(0, 1) prod_(j < t) N(mu(x_j), 1 / lambda(x_j)),  x_j the step as above
    whose precision is 1 + sum lambda, and whose mean is sum lambda mu by it. It learns by the critics' loss, and by
        L = beta KL(q_t | N(0, 1))
    ``cadm`` (Lee et al. 2020): an MLP encodes the last K steps as a context z_t, a point, of which networks see all.
    Models predict the next D steps j from t on, forward and backward in time:
        L = mean_j mean_d ((F(s_j, a_j, z_t) - (s'_j - s_j))^2 + c' (B(s'_j, a_j, z_t) - (s_j - s'_j))^2)

    L is added to the critics' loss. In varibad and cadm no loss of actor or critics trains what infers the task; in
    pearl the critics' does, and the actor's does not. It learns through the steps of a window, which begins with the
    memory that acting had there, and the trial is as much of it as lies in the window: let a rollout hold whole trials.
    An actor that learns from rollouts sees what the parameters that played a rollout infer while it learns from it.

    Differs from VariBAD: states are predicted too; it learns from the steps that actor and critics learn from, and not
    from a buffer of trials; L is divided by n. Differs from PEARL: the prior is one of the factors; networks see q, and
    no sample of it; what is read is the trial so far, and no random set. Differs from CaDM: of a step the change of
    state is read too; the models teach the context alone, and plan nothing.
    """

    inference: Literal["varibad", "pearl", "cadm"] = "varibad"
    """How the task is inferred: by predicting the trial's rewards and states (varibad), by a product of Gaussians that
    the critics teach (pearl), or by predicting the next states from the last steps (cadm)."""
    latent_size: int = 5
    """Size of the latent task."""
    recurrent_size: int = 64
    """Size of the hidden state."""
    inferred_from: int = 8
    """Number of last steps from which the task is inferred; they are stored with every transition."""
    inference_widths: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers in the networks that read or predict steps."""
    decoded_steps: int = 10
    """Number of steps D that each belief predicts: any of the trial (varibad), or the next ones (cadm)."""
    kl_coefficient: float = 0.1
    """Weight of a belief's divergence from the one before (varibad) or from the prior (pearl)."""
    state_coefficient: float = 1.0
    """Weight of the prediction of states beside that of rewards (varibad)."""
    backward_coefficient: float = 0.5
    """Weight of the prediction backward in time beside that forward (cadm)."""

    draws: ClassVar[bool] = True

    def __post_init__(self):
        super().__post_init__()
        parts.require_counts(self, "latent_size", "recurrent_size", "inferred_from", "decoded_steps")
        parts.require_layers(self, "inference_widths")
        parts.require_not_negative(self, "kl_coefficient", "state_coefficient", "backward_coefficient")

    @property
    def way(self) -> Inference:
        """The way in which the task is inferred."""
        return INFERENCES[self.inference](self)

    def init(self, num_tasks: int, seen: Any, action: Array, own: bool, key: Key) -> Params:
        modules = self.way.modules(seen.obs, action)

        def init(key: Key) -> dict[str, Any]:
            keys = jax.random.split(key, len(modules))
            return {name: module.init(k, *x) for k, (name, (module, *x)) in zip(keys, modules.items(), strict=True)}

        return init_params(init, own, key, num_tasks)

    def begin(self, obs_size: int, action_size: int) -> Array:
        return self.way.begin(obs_size, action_size)

    def read(self, params: dict[str, Any], step: Any) -> Array:
        return self.way.read(params, step)

    def advance(self, params: dict[str, Any], memory: Array, read: Array) -> Array:
        return self.way.advance(params, memory, read)

    def show(self, params: dict[str, Any], memory: Array) -> Array:
        return self.way.show(params, memory)

    def join(self, loss: Array, metrics: Metrics, params: dict[str, Any], seen: Any) -> tuple[Array, Metrics]:
        track = self.burned_in(params, seen.past)
        losses = self.way.losses(params, track, *self.over(params, track))
        return loss + sum(losses.values()), metrics | losses
