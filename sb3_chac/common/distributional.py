"""The distributional critic's arithmetic: Gaussian returns Z(s, a) ~ N(Q(s, a), sigma(s, a)^2)."""

import math

import torch as th

from sb3_chac.common.linear import is_traced


def gaussian_surrogate_loss(
    q_values: th.Tensor,
    stds: th.Tensor,
    mean_targets: th.Tensor,
    sampled_targets: th.Tensor,
    running_std: th.Tensor,
    eta: float = 1.0,
    clip_factor: float = 3.0,
    epsilon: float = 0.1,
) -> th.Tensor:
    """
    Compute the per-sample surrogate of the Gaussian negative log-likelihood, C-HAC's critic loss.

    It is that of DSAC-T (Duan et al. 2023, arXiv 2310.05858, "three refinements"). Only its gradient means something, its
    value does not:

        d/dQ     = -(b^2 + e) (y_q - Q) / (sigma^2 + e)
        d/dsigma = -(b^2 + e) (d^2 - eta sigma^2) / (sigma^3 + e),      d = clip(y_z - Q, -c b, c b)

    The mean follows the target without sampling noise, the standard deviation follows the sampled target, clipped to
    ``c`` running standard deviations; the weight ``b^2 + e`` makes the step independent of the scale of the reward.
    ``eta = 1`` keeps sigma calibrated: in the fixed point ``E[d^2] = eta sigma^2``.

    :param q_values: Q, mean returns, shape (..., batch_size)
    :param stds: sigma, standard deviations of the return, same shape, positive
    :param mean_targets: y_q, broadcastable to ``q_values``
    :param sampled_targets: y_z, broadcastable to ``q_values``
    :param running_std: b, broadcastable to ``q_values``, e.g. shape (n_critics, 1)
    :param eta: weight of sigma^2 in the gradient of the standard deviation, > 0
    :param clip_factor: c
    :param epsilon: e, keeps the divisions stable
    :return: shape (..., batch_size), no reduction
    """
    with th.no_grad():
        bound = clip_factor * running_std
        error = th.clamp(sampled_targets - q_values, -bound, bound)
        weight = running_std.square() + epsilon
        variances = stds.square()
        q_gradient = -weight * (mean_targets - q_values) / (variances + epsilon)
        std_gradient = -weight * (error.square() - eta * variances) / (variances * stds + epsilon)
    return q_gradient * q_values + std_gradient * stds


def return_targets(
    rewards: th.Tensor, discounts: th.Tensor, next_q_values: th.Tensor, next_stds: th.Tensor, entropy_term: th.Tensor
) -> tuple[th.Tensor, th.Tensor]:
    """
    Targets of DSAC-T: ``y_q = r + gamma (1 - d) (Q_m(s', a') - alpha log pi(a'|s'))``, and y_z with a sample of Z_m(s', a') in
    place of its mean; m is the target critic with the smaller mean.

    :param rewards: r, shape (batch_size,), as all others
    :param discounts: gamma (1 - d)
    :param next_q_values: Q_m(s', a')
    :param next_stds: sigma_m(s', a')
    :param entropy_term: alpha log pi(a'|s')
    :return: y_q and y_z, both of shape (batch_size,)
    """
    mean_targets = rewards + discounts * (next_q_values - entropy_term)
    return mean_targets, mean_targets + discounts * clipped_normal_like(next_q_values) * next_stds


def gaussian_nll(q_values: th.Tensor, stds: th.Tensor, sampled_targets: th.Tensor) -> th.Tensor:
    """
    Negative log-likelihood of sampled returns, the figure to watch in place of the surrogate's value.

    :param q_values: Q, shape (..., batch_size)
    :param stds: sigma, same shape
    :param sampled_targets: y_z, broadcastable to ``q_values``
    :return: shape (..., batch_size), in nats
    """
    return 0.5 * ((sampled_targets - q_values) / stds).square() + stds.log() + 0.5 * math.log(2 * math.pi)


def clipped_normal_like(values: th.Tensor, bound: float = 3.0) -> th.Tensor:
    """
    Standard normal noise, clipped to ``[-bound, bound]`` and rescaled to unit variance. Without the rescaling the
    half percent of variance that clipping at 3 takes away would compound over the horizon: sigma would come out 10 %
    too small at gamma 0.99.

    :param values: gives the shape, dtype and device
    :param bound: largest deviation before rescaling, in standard deviations
    """
    inside = math.erf(bound / math.sqrt(2))
    density = math.exp(-0.5 * bound**2) / math.sqrt(2 * math.pi)
    variance = inside - 2 * bound * density + bound**2 * (1 - inside)
    return th.randn_like(values).clamp_(-bound, bound).div_(math.sqrt(variance))


def probability_of_improvement(
    q_values: th.Tensor, stds: th.Tensor, baseline_q_values: th.Tensor, baseline_stds: th.Tensor
) -> th.Tensor:
    """
    ``P(X > Y) = Phi((Q_X - Q_Y) / sqrt(sigma_X^2 + sigma_Y^2))`` of independent X ~ N(Q_X, sigma_X^2), Y ~ N(Q_Y, sigma_Y^2):
    C-HAC's confidence that an action brings a higher return than the baseline's.

    :param q_values: Q_X, any shape
    :param stds: sigma_X, same shape, as the other two
    :return: between 0 and 1, same shape; 0.5 where both distributions are the same
    """
    spread = (stds.square() + baseline_stds.square()).sqrt()
    score = (q_values - baseline_q_values) / spread
    # ONNX has no ndtr, which is more precise where the probability is small
    return 0.5 * (1 + th.erf(score / math.sqrt(2))) if is_traced() else th.special.ndtr(score)
