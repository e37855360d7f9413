"""A prediction head per agent class, for vocabularies whose classes have different sizes."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from rlftsim.policies.smart.embeddings import MlpLayer
from rlftsim.policies.token_rows import NEVER


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
