"""Units of an agent's actor and critics that begin anew after an update, with what its optimisers remember of them."""

from collections.abc import Callable
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.agents.base import BaseAgent
from mtjax.agents.networks import Network, Params, ReLU
from mtjax.agents.parts.plasticity import NET, Layer, forget
from mtjax.agents.state import AgentState, Nets, over_tasks
from mtjax.parallel import collectives
from mtjax.types import Array, Key

_MLP = "MLP_0"  # flax's name of the layers of a trunk


def begin(agent: BaseAgent, nets: Nets) -> Nets:
    """Return what is remembered of the units of new networks, as a network by name."""
    if not agent.plasticity.every:
        return {}

    def of_net(net: Params) -> list[Any]:
        init = lambda _=None: agent.plasticity.init([layer["bias"].shape[-1] for layer in _dense(net.shared)])
        return jax.vmap(init)(net.shared["head"]["bias"]) if _several(net) else init()

    return {NET: Params({name: of_net(nets[name]) for name in ("actor", "critic")}, {})}


def renew(agent: BaseAgent, state: AgentState, batch: Any, key: Key, number: Array) -> AgentState:
    """Begin units anew after update ``number`` (), if it is time for that, by what they put out for a batch (T, B)."""
    every = agent.plasticity.every
    if not every:
        return state
    act = partial(_renew, agent, batch, key)
    return act(state) if every == 1 else jax.lax.cond((number + 1) % every == 0, act, lambda state: state, state)


def _renew(agent: BaseAgent, batch: Any, key: Key, state: AgentState) -> AgentState:
    actions = (batch.action,) if agent.num_critics else ()
    seen = {
        "actor": over_tasks(agent.view.actor_inputs, state.nets, batch.features, batch.obs),
        "critic": (*over_tasks(agent.view.critic_inputs, state.nets, batch.features, batch.obs), *actions),
    }
    kept, (nets, fits) = state.nets[NET].shared, (state.nets, state.fits)
    for name, network in {"actor": agent.actor, "critic": agent.critic}.items():
        one = partial(_of_network, agent, network, seen[name])
        several = _several(nets[name])
        keys = jax.random.fold_in(key, list(seen).index(name))
        keys = jax.random.split(keys, len(nets[name].shared["head"]["bias"])) if several else keys
        shared, memory, units = (jax.vmap(one) if several else one)(nets[name].shared, kept[name], keys)
        nets = nets | {name: nets[name]._replace(shared=shared)}
        kept = kept | {name: memory}
        forgetting = jax.vmap(_forgotten) if several else _forgotten
        fits = fits | {name: fits[name]._replace(optimizer=_moments(fits[name].optimizer, name, forgetting, units))}
    return state._replace(nets=nets | {NET: Params(kept, {})}, fits=fits)


def _of_network(agent: BaseAgent, network: Network, seen: tuple, shared: Any, memory: list, key: Key) -> tuple:
    """Return the shared parameters of one network, what is remembered, and which units of each layer begin anew."""
    layers = jax.vmap(partial(hidden_layers, network, Params(shared, {})))(*seen)  # leaves (T, B, H)
    memories, begun = [], []
    for i, hidden in enumerate(layers):
        hidden = hidden.reshape(-1, hidden.shape[-1])
        hidden = collectives.whole(hidden, axis=0) if agent.devices_differ else hidden
        layer = _layer(shared, i)
        fresh = nn.initializers.lecun_normal()(jax.random.fold_in(key, i), layer.into.shape)
        kept, layer, units = agent.plasticity.renew(memory[i], layer, hidden, fresh)
        shared = _with_norm(_with_layer(shared, i, layer), i, units, 1.0)
        memories, begun = [*memories, kept], [*begun, units]
    return shared, memories, begun


def hidden_layers(network: Network, params: Params, features: Array, obs: Array, *action: Array) -> list[Array]:
    """Return what the units (..., H) of each hidden layer put out, of a network whose body is an MLP."""
    units = lambda module, _: isinstance(module, ReLU)
    kept = {"capture_intermediates": units, "mutable": ["intermediates"]}
    _, found = network.body.apply(params.parts["body"], obs, features, *action, **kept)  # type: ignore
    layers = found["intermediates"][_MLP]  # type: ignore
    return [layers[f"ReLU_{i}"]["__call__"][0] for i in range(len(layers))]  # type: ignore


def _forgotten(shared: Any, units: list[Array]) -> Any:
    """Return an optimiser's moments of shared parameters, 0 around the units (H,) of each layer that begin anew."""
    for i, chosen in enumerate(units):
        shared = _with_norm(_with_layer(shared, i, forget(_layer(shared, i), chosen)), i, chosen, 0.0)
    return shared


def _moments(optimizer: Any, name: str, forgetting: Callable, units: list[Array]) -> Any:
    """Return an optimiser's state in which all that is as the parameters of a network has forgotten some units."""
    are_nets = lambda x: isinstance(x, dict) and isinstance(x.get(name), Params)
    of_net = lambda net: net._replace(shared=forgetting(net.shared, units))
    return jax.tree.map(lambda x: x | {name: of_net(x[name])} if are_nets(x) else x, optimizer, is_leaf=are_nets)


# The layers of a network, in trees like its shared parameters.


def _several(net: Params) -> bool:
    """Return whether a net is several networks, leaves (N, ...)."""
    return net.shared["head"]["bias"].ndim > 1


def _dense(shared: Any) -> list[dict[str, Array]]:
    """Return the dense layers below the head."""
    mlp = shared["body"]["params"][_MLP]
    return [mlp[f"Dense_{i}"] for i in range(sum(name.startswith("Dense") for name in mlp))]


def _layer(shared: Any, i: int) -> Layer:
    """Return the weights around the units of hidden layer i."""
    dense = [*_dense(shared), shared["head"]]
    return Layer(dense[i]["kernel"], dense[i]["bias"], dense[i + 1]["kernel"])


def _with_layer(shared: Any, i: int, layer: Layer) -> Any:
    """Put other weights around the units of hidden layer i."""
    dense = [*_dense(shared), shared["head"]]
    dense[i] = {"kernel": layer.into, "bias": layer.bias}
    dense[i + 1] = dense[i + 1] | {"kernel": layer.out}
    *inner, head = dense
    changed = {f"Dense_{j}": each for j, each in enumerate(inner)}
    return _with_mlp(shared | {"head": head}, changed)


def _with_norm(shared: Any, i: int, units: Array, scale: float) -> Any:
    """Set scale and bias of the layer normalisation of some units (H,) of hidden layer i, if there is one."""
    name = f"LayerNorm_{i}"
    norm = shared["body"]["params"][_MLP].get(name)
    if norm is None:
        return shared
    new = {"scale": jnp.where(units, scale, norm["scale"]), "bias": jnp.where(units, 0.0, norm["bias"])}
    return _with_mlp(shared, {name: new})


def _with_mlp(shared: Any, changed: dict[str, Any]) -> Any:
    body = shared["body"]
    mlp = body["params"][_MLP] | changed
    return shared | {"body": body | {"params": body["params"] | {_MLP: mlp}}}
