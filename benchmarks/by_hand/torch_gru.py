"""A GRU with 32 units in PyTorch, its initial state a small network of the past window, trained by
Adam on the simulation error of the whole record. Prints the held-out error every 25 updates."""

import sys

import numpy as np
import torch


class Network(torch.nn.Module):
    """past (B, 10), u (B, T, 1) -> y (B, T, 1), z-scored."""

    def __init__(self, hidden=32):
        super().__init__()
        self.start = torch.nn.Sequential(
            torch.nn.Linear(10, hidden), torch.nn.Tanh(), torch.nn.Linear(hidden, hidden)
        )
        self.gru = torch.nn.GRU(1, hidden, batch_first=True)
        self.out = torch.nn.Linear(hidden + 1, 1)

    def forward(self, past, u):
        """Simulate."""
        h, _ = self.gru(u, torch.tanh(self.start(past))[None])
        return self.out(torch.cat([h, u], dim=-1))


def main():
    """Train until the target is reached."""
    d = np.load(sys.argv[1])
    torch.manual_seed(int(d["seed"]))
    torch.set_num_threads(1)
    mean_u, mean_y = d["train_u"].mean(), d["train_y"].mean()
    std_u, std_y = d["train_u"].std(), d["train_y"].std()

    def tensor(values, mean, std):
        return torch.tensor((values - mean) / std, dtype=torch.float32)[None]

    def window(past_u, past_y):
        parts = tensor(past_u, mean_u, std_u).flatten(1), tensor(past_y, mean_y, std_y).flatten(1)
        return torch.cat(parts, dim=1)

    past = window(d["train_u"][:5], d["train_y"][:5])
    u, y = tensor(d["train_u"][5:], mean_u, std_u), tensor(d["train_y"][5:], mean_y, std_y)
    later, future = window(d["past_u"], d["past_y"]), tensor(d["u"], mean_u, std_u)
    network = Network()
    optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
    for epoch in range(1, 100_001):
        optimiser.zero_grad()
        loss = torch.mean((network(past, u) - y) ** 2)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        if epoch % 25:
            continue
        with torch.no_grad():
            y_hat = network(later, future)[0].numpy() * std_y + mean_y
        error = float(np.sqrt(np.mean((y_hat - d["y"]) ** 2)) / d["scale"][0])
        print("error", error, flush=True)
        if error <= d["target"]:
            return


main()
