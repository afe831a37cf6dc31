"""Behaviour cloning in PyTorch: one network for the levels of a split, fed by PyTorch's DataLoader or by grain.

python clone_torch.py SPLIT [torch|grain]
"""

import sys
from collections.abc import Iterator

import numpy as np
import torch

import levelproof

CHOICES = 3, 3, 3, 3, 2, 2  # of the action's entries: motors, then thrusters
EPOCHS, BATCH = 20, 16  # records of 256 steps


def loaded(source, loader: str) -> Iterator[dict[str, torch.Tensor]]:
    """Yield batches of all epochs: tensors [record, time, ...] by name."""
    if loader == "torch":
        for _ in range(EPOCHS):
            yield from torch.utils.data.DataLoader(source, BATCH, shuffle=True)
        return
    import grain

    sampler = grain.samplers.IndexSampler(len(source), shuffle=True, seed=0, num_epochs=EPOCHS)
    for batch in grain.DataLoader(data_source=source, sampler=sampler, operations=[grain.transforms.Batch(BATCH)]):
        yield {name: torch.from_numpy(np.array(x)) for name, x in batch.items()}


def loss_of(network: torch.nn.Module, batch: dict[str, torch.Tensor]) -> torch.Tensor:
    """Return the negative log-likelihood of the live entries of first episodes; every level weighs the same."""
    logits = network(batch["observation"]).split(CHOICES, -1)
    entries = zip(logits, batch["action"].long().unbind(-1), strict=True)
    losses = [torch.nn.functional.cross_entropy(x.movedim(-1, 1), a, reduction="none") for x, a in entries]
    ended = batch["done"].long().cumsum(1) - batch["done"].long()  # episodes before each step
    first = (ended == 0) & batch["mask"]
    live = (batch["action_mask"] & first[..., None]).float()
    of_level = (torch.stack(losses, -1) * live).sum((1, 2)) / live.sum((1, 2)).clamp(min=1)
    return of_level.mean()


def main(split: str, loader: str = "torch") -> None:
    torch.manual_seed(0)
    data = levelproof.open(split, where="label = 'solved'")
    train, validation = (data.torch(subset=subset) for subset in ("train", "validation"))
    width = train[0]["observation"].shape[-1]
    layers = torch.nn.Linear(width, 256), torch.nn.Tanh(), torch.nn.Linear(256, 256), torch.nn.Tanh()
    network = torch.nn.Sequential(*layers, torch.nn.Linear(256, sum(CHOICES)))
    optimiser, losses = torch.optim.AdamW(network.parameters(), 1e-3), []
    for batch in loaded(train, loader):
        loss = loss_of(network, batch)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    with torch.no_grad():
        held = [loss_of(network, batch).item() for batch in torch.utils.data.DataLoader(validation, BATCH)]
    per_epoch = len(losses) // EPOCHS
    first, last = np.mean(losses[:per_epoch]), np.mean(losses[-per_epoch:])
    print(f"loss {first:.3f} in the first epoch, {last:.3f} in the last, {np.mean(held):.3f} on validation levels")


if __name__ == "__main__":
    main(*sys.argv[1:])
