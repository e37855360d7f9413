"""Heads beside SMART's own: one per agent class, for vocabularies whose classes have different sizes, and scores of
tokens by where they lead."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from rlftsim.policies.smart.embeddings import FourierEmbedding, MlpLayer
from rlftsim.policies.token_rows import NEVER
from rlftsim.tokens.vocabulary import CLASS_BOXES_M

KEY_FREQUENCIES = 16
"""Learned frequencies per input of a token's key."""
UNITS_PER_BOX = 20.0
"""Keys see positions in twentieths of the length of the class's box: log-spaced periods are then 1/20 to 3 lengths."""
UNITS_PER_RAD = 4.0
"""Likewise: from 1/4 rad on."""


class ClassHeads(nn.ModuleList):
    """Features of R agents -> logits of the tokens of their own class, padded to V tokens."""

    def __init__(self, dim: int, class_sizes: tuple[int, ...], num_tokens: int):
        super().__init__(MlpLayer(dim, dim, size) for size in class_sizes)
        self.class_sizes = class_sizes
        self.num_tokens = num_tokens

    def forward(self, features: Float[Tensor, "R D"], class_id: Int64[Tensor, "R"]) -> Float[Tensor, "R V"]:
        """float32 logits; tokens that a class lacks get `NEVER`.

        Args:
            features: of the agents.
            class_id: of the agents.
        """
        logits = torch.full((len(features), self.num_tokens), NEVER, device=features.device)
        if features.device.type != "cpu":
            # each head sees all rows: to leave some out, the host would wait for their number
            for index, (head, size) in enumerate(zip(self, self.class_sizes)):
                own = functional.pad(head(features).float(), (0, self.num_tokens - size), value=NEVER)
                # those of padding, whose class has no head, are arbitrary
                logits = torch.where((class_id >= index)[:, None], own, logits)
            return logits
        for index, (head, size) in enumerate(zip(self, self.class_sizes)):
            # each head sees the rows of its class only
            rows = (class_id == index).nonzero()[:, 0]
            logits[rows, :size] = head(features[rows]).float()
        return logits


class MotionScores(nn.Module):
    """A second term of the logits: the product of a query, made of an agent's features, and a key of each token.

    SMART's head has a free vector for each token, which is learned from the times that the token is chosen; most of a
    thousand tokens are rare. A key is a smooth function of where a token leads, so tokens that lead to nearly the same
    place are scored alike and learned together.
    """

    def __init__(self, dim: int, key_dim: int):
        super().__init__()
        self.query = nn.Linear(dim, key_dim, bias=False)
        self.key = FourierEmbedding(3, key_dim, KEY_FREQUENCIES)

    def keys(self, poses: Float[Tensor, "C V 3"]) -> Float[Tensor, "V CK"]:
        """Keys of all tokens, those of the classes side by side.

        Args:
            poses: where each token leads (x, y, heading), meters and radians, in the agent's frame.
        """
        per_m = [UNITS_PER_BOX / length for length, _ in CLASS_BOXES_M]
        unit = poses.new_tensor([(one, one, UNITS_PER_RAD) for one in per_m])  # [C, 3]
        keys = self.key((poses * unit[:, None]).flatten(0, 1)).unflatten(0, poses.shape[:2])  # [C, V, K]
        return keys.transpose(0, 1).flatten(1)

    def queries(self, hidden: Float[Tensor, "R D"], class_id: Int64[Tensor, "R"]) -> Float[Tensor, "R CK"]:
        """Queries, zero for the keys of other classes; all zero for padding, whose class has no keys.

        Args:
            hidden: features that the last map of SMART's head reads.
            class_id: of the agents.
        """
        classes = torch.arange(len(CLASS_BOXES_M), device=class_id.device)
        query = self.query(hidden)
        return ((class_id[:, None] == classes)[..., None] * query[:, None]).flatten(1)
