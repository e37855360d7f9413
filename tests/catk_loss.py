"""The loss of a CAT-K update, by itself."""

from rlftsim.training.imitation import predict_targets, summed_loss


def catk_loss(policy, batch, targeted, trained):
    """Mean cross-entropy of the targets along CAT-K rollouts, nats; 0 where nothing counts. Differentiable."""
    summed = summed_loss(predict_targets(policy, policy.encode(batch), targeted, trained), 0.0)
    return summed.loss / summed.count.clamp(min=1)
