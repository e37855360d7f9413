"""New tokens at the indices of a model's tokens, so that the model can be trained further with the new tokens.

A vocabulary that was built from other traffic may lack the motions of an agent: that of the synthetic scenarios has no
pedestrian faster than 2.4 m/s and no cyclist faster than 7.4 m/s. A model knows tokens by index, so new tokens get the
indices of the most similar old tokens.
"""

from collections.abc import Collection
from dataclasses import replace

import torch
from scipy.optimize import linear_sum_assignment

from rlftsim.errors import ConfigError
from rlftsim.tokens.vocabulary import CLASS_NAMES, STILL_TOKEN, Vocabulary


def align_vocabulary(vocabulary: Vocabulary, model_vocabulary: Vocabulary, *, keep: Collection[str] = ()) -> Vocabulary:
    """A vocabulary with tokens reordered to a model's vocabulary, so that the sum of distances is smallest.

    Map prototypes and the number of tokens are those of the model. The token that stands still keeps the index. Only
    for models with the same head for all classes.

    Args:
        vocabulary: Vocabulary with the new tokens.
        model_vocabulary: Vocabulary of the model that is trained further; decides on sizes and map prototypes.
        keep: Names of classes, of `CLASS_NAMES`, that keep the model's tokens.

    Raises:
        ConfigError: A class has more tokens than the model has indices, or a name is not that of a class.

    Source: the assignment is `scipy.optimize.linear_sum_assignment`.
    """
    wrong_names = sorted({*keep} - {*CLASS_NAMES})
    if wrong_names:
        raise ConfigError(f"no class {wrong_names[0]!r}: classes are {', '.join(CLASS_NAMES)}.")
    corners, mask = model_vocabulary.corners.clone(), model_vocabulary.token_mask.clone()
    for index, name in enumerate(CLASS_NAMES):
        if name in keep:
            continue
        tokens = vocabulary.corners[index, vocabulary.token_mask[index]]  # [n, 6, 4, 2]
        if len(tokens) > model_vocabulary.num_tokens:
            raise ConfigError(
                f"{len(tokens)} {name} tokens do not fit into the {model_vocabulary.num_tokens} places of the model: "
                "build a smaller vocabulary, such as with --tokens.num-tokens."
            )
        # Mean distance of the boxes' corners over steps 1..5, m, in float64 [n, V]. A row at a time: all pairs of 1024
        # tokens would take 300 MB.
        table = model_vocabulary.corners[index, :, 1:]
        distance = torch.stack([(token[1:] - table).double().norm(dim=-1).mean((1, 2)) for token in tokens])
        # Indices without a token come last: their weights were never trained.
        distance[:, ~model_vocabulary.token_mask[index]] += 1.0 + distance.max()
        distance[:, STILL_TOKEN] += 1e6
        distance[STILL_TOKEN, STILL_TOKEN] = 0.0
        rows, token_ids = (torch.from_numpy(indices) for indices in linear_sum_assignment(distance.numpy()))
        corners[index], mask[index] = 0.0, False
        corners[index, token_ids], mask[index, token_ids] = tokens[rows], True
    sources = ", ".join((*(f"{name} tokens" for name in keep), "map pieces"))
    origin = f"{vocabulary.origin}; in the places of, and {sources} from: {model_vocabulary.origin}"
    return replace(model_vocabulary, corners=corners, token_mask=mask, origin=origin)
