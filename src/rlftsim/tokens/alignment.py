"""The tokens of one vocabulary in the places of another one's, so that a model can be trained further with them.

A vocabulary that was built from other traffic may lack what an agent does: that of the synthetic scenarios has no
pedestrian faster than 2.4 m/s and no cyclist faster than 7.4 m/s. A model knows its tokens by their places, so new ones
are put where the most similar old ones were.
"""

from collections.abc import Collection
from dataclasses import replace

import torch
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.tokens.vocabulary import CLASS_NAMES, STILL_TOKEN, Vocabulary


def align_vocabulary(vocabulary: Vocabulary, other: Vocabulary, *, keep: Collection[str] = ()) -> Vocabulary:
    """A vocabulary with its tokens in the places of another one's, so that the sum of distances is least.

    Map prototypes and the number of places are the other's. The token that stands still stays in its place. Only for
    models in which all classes share one head.

    Args:
        vocabulary: with the new tokens.
        other: of the model that is trained further.
        keep: names of classes whose tokens stay the other's, of `CLASS_NAMES`.

    Raises:
        ConfigError: a class has more tokens than the other vocabulary has places, or there is no class of a name.

    Source: the assignment is `scipy.optimize.linear_sum_assignment`.
    """
    unknown = sorted({*keep} - {*CLASS_NAMES})
    if unknown:
        raise ConfigError(f"no class {unknown[0]!r}: classes are {', '.join(CLASS_NAMES)}.")
    corners, mask = other.corners.clone(), other.token_mask.clone()
    for index, name in enumerate(CLASS_NAMES):
        if name in keep:
            continue
        new = vocabulary.corners[index, vocabulary.token_mask[index]]  # [n, 6, 4, 2]
        if len(new) > other.num_tokens:
            raise ConfigError(
                f"{len(new)} {name} tokens do not fit into the {other.num_tokens} places of the model: build a "
                "smaller vocabulary, such as with --tokens.num-tokens."
            )
        distance = _distances(new, other.corners[index])  # [n, V]
        # Places without a token come last: their weights were never trained.
        distance[:, ~other.token_mask[index]] += 1.0 + distance.max()
        distance[:, STILL_TOKEN] += 1e6
        distance[STILL_TOKEN, STILL_TOKEN] = 0.0
        tokens, places = (torch.from_numpy(found) for found in linear_sum_assignment(distance.numpy()))
        corners[index], mask[index] = 0.0, False
        corners[index, places], mask[index, places] = new[tokens], True
    kept = ", ".join((*(f"{name} tokens" for name in keep), "map pieces"))
    origin = f"{vocabulary.origin}; in the places of, and {kept} from: {other.origin}"
    return replace(other, corners=corners, token_mask=mask, origin=origin)


def _distances(new: Float[Tensor, "n 6 4 2"], old: Float[Tensor, "V 6 4 2"]) -> Float[Tensor, "n V"]:
    """Mean distance of the boxes' corners over steps 1..5, m, in float64."""
    # a row at a time: all pairs of 1024 tokens would take 300 MB
    return torch.stack([(token[1:] - old[:, 1:]).double().norm(dim=-1).mean((1, 2)) for token in new])
