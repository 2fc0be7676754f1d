"""
Multilayer perceptrons, and stacks of them, as one node of autograd's graph with a hand-derived backward pass.

On small networks most of a gradient step is not arithmetic but the bookkeeping of dozens of small operations. Here each
network is evaluated by one call forwards and one backwards, and gradients that nobody asks for (those of the observations,
when an actor climbs a critic) are not computed.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch as th
from torch import nn
from torch.autograd.function import once_differentiable

from sb3_chac.common.linear import StackedLinear, is_traced, product, use_fast_linear


class Activation(NamedTuple):
    """An elementwise function and its derivative."""

    forward: Callable[[th.Tensor], th.Tensor]
    # Of the gradient after it, the values before it and the values after it: the gradient before it
    backward: Callable[[th.Tensor, th.Tensor, th.Tensor], th.Tensor]


ACTIVATIONS: dict[type[nn.Module], Activation] = {
    nn.ReLU: Activation(nn.functional.relu, lambda grad, before, after: th.ops.aten.threshold_backward(grad, after, 0)),
    nn.GELU: Activation(nn.functional.gelu, lambda grad, before, after: th.ops.aten.gelu_backward(grad, before)),
    nn.Tanh: Activation(th.tanh, lambda grad, before, after: th.ops.aten.tanh_backward(grad, after)),
}


class MLPFunction(th.autograd.Function):
    """
    One or several MLPs of one shape on the same inputs.

    ``forward`` takes the activation after each layer (or None), the features (batch_size, n_features), the actions
    (batch_size, n_actions) that follow them or None, and weight and bias of each layer in turn; of a stack with one more
    dimension in front, which the outputs then have, too.
    """

    @staticmethod
    def forward(
        ctx: Any,
        activations: list[Activation | None],
        features: th.Tensor,
        actions: th.Tensor | None,
        *parameters: th.Tensor,
    ) -> th.Tensor:
        inputs = features if actions is None else th.cat([features, actions], dim=1)
        before, after = [], []
        for layers in _networks(parameters):
            values = inputs
            for activation, (weight, bias) in zip(activations, layers, strict=True):
                before.append(product(values, weight, bias))
                values = before[-1] if activation is None else activation.forward(before[-1])
                after.append(values)
        ctx.save_for_backward(inputs, *parameters, *before, *after)
        ctx.activations, ctx.n_features = activations, features.shape[1]
        outputs = after[len(activations) - 1 :: len(activations)]
        return th.stack(outputs) if parameters[0].dim() == 3 else outputs[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: th.Tensor) -> tuple[Any, ...]:
        n_layers, n = len(ctx.activations), ctx.n_features
        inputs, parameters, rest = (
            ctx.saved_tensors[0],
            ctx.saved_tensors[1 : 1 + 2 * n_layers],
            ctx.saved_tensors[1 + 2 * n_layers :],
        )
        before, after = rest[: len(rest) // 2], rest[len(rest) // 2 :]
        _, needs_features, needs_actions, *needs_parameters = ctx.needs_input_grad
        stacked = parameters[0].dim() == 3
        grad_parameters: list[list[th.Tensor]] = [[] for _ in parameters]  # of each parameter, one per network
        grad_features, grad_actions = [], []
        for i, layers in enumerate(_networks(parameters)):
            grad = grad_outputs[0][i] if stacked else grad_outputs[0]
            for j in reversed(range(n_layers)):
                k, activation = i * n_layers + j, ctx.activations[j]
                if activation is not None:
                    grad = activation.backward(grad, before[k], after[k])
                if needs_parameters[2 * j]:
                    grad_parameters[2 * j].append(product(grad.t(), (after[k - 1] if j > 0 else inputs).t()))
                if needs_parameters[2 * j + 1]:
                    grad_parameters[2 * j + 1].append(grad.sum(dim=0))
                if j > 0:
                    grad = product(grad, layers[j][0].t())
            first_weight = layers[0][0]
            if needs_features:
                grad_features.append(product(grad, first_weight[:, :n].t()))
            if needs_actions:
                grad_actions.append(grad @ first_weight[:, n:])
        return (
            None,
            _sum(grad_features),
            _sum(grad_actions),
            *((th.stack(grads) if stacked else grads[0]) if grads else None for grads in grad_parameters),
        )


def _networks(parameters: tuple[th.Tensor, ...]) -> list[list[tuple[th.Tensor, th.Tensor]]]:
    """
    Collect the layers of each network.

    :return: weight and bias of each layer, for each network of the stack
    """
    layers = list(zip(parameters[::2], parameters[1::2], strict=True))
    if parameters[0].dim() == 2:
        return [layers]
    return list(zip(*(zip(weight, bias, strict=True) for weight, bias in layers), strict=True))


def _sum(tensors: list[th.Tensor]) -> th.Tensor | None:
    return th.stack(tensors).sum(dim=0) if len(tensors) > 1 else tensors[0] if tensors else None


class FastMLP(nn.Sequential):
    """A ``nn.Sequential`` of linear layers and activations, on top of :class:`MLPFunction` while gradients are wanted."""

    def forward(self, features: th.Tensor, actions: th.Tensor | None = None) -> th.Tensor:
        """
        Evaluate the network or the stack of networks.

        :param features: shape (batch_size, n_features)
        :param actions: shape (batch_size, n_actions), to follow the features
        :return: shape (batch_size, n_outputs); of a stack (n_stack, batch_size, n_outputs)
        """
        if features.dim() == 2 and th.is_grad_enabled() and not is_traced():
            activations: list[Activation | None] = []
            parameters: list[th.Tensor] = []
            for layer in self:
                if isinstance(layer, nn.Linear | StackedLinear):
                    activations.append(None)
                    parameters += [layer.weight, layer.bias]
                else:
                    activations[-1] = ACTIVATIONS[type(layer)]
            return MLPFunction.apply(activations, features, actions, *parameters)
        return super().forward(features if actions is None else th.cat([features, actions], dim=1))


def is_covered(module: nn.Module) -> bool:
    """Tell whether a module is a plain ``nn.Sequential`` of linear layers, each with a known activation after it or none."""
    if type(module) is not nn.Sequential or len(module) == 0:
        return False
    after_linear = False
    for layer in module:
        linear = isinstance(layer, nn.Linear | StackedLinear) and layer.bias is not None
        known = type(layer) in ACTIVATIONS and getattr(layer, "approximate", "none") == "none"
        if not linear and not (known and after_linear):
            return False
        after_linear = linear
    return True


def use_fast_mlps(module: nn.Module) -> None:
    """Turn what can be turned into a :class:`FastMLP` or a ``FastLinear``; parameters and their names stay what they are."""
    for part in module.modules():
        if is_covered(part):
            part.__class__ = FastMLP
    use_fast_linear(module)
