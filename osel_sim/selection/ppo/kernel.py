"""PPO's training step for one small network on one small rollout, compiled: what SB3 does, with each weight visited once a step.

With the paper's settings SB3 spends nearly all of a replay in Adam and in gradients: a rollout of 5 decisions is trained on up to ten times, each
time two and a half million weights at most, their gradients and two moments each are read and written over and over by separate operations. Here

- a layer's gradient is never stored: it is the product of the layer's deltas and inputs, formed some rows at a time just before Adam runs over them;
- its norm, which clipping needs beforehand, comes from the products of deltas and of inputs among the few decisions of the rollout;
- the forward pass after a step happens in the same visit, on the rows just written.

A tower (policy or value network) is a chain of fully connected layers with tanh or GELU between them, its weights and biases in one flat float32
array: layer after layer, the matrix (outputs, inputs) by rows, then the bias. What it makes of a batch is float32 (2, layers, batch, widest): each
layer's outputs, and the slopes of the function between layers where they were formed.
"""

import math

import numpy as np

from osel_sim.core.compiled import njit

BETA1, BETA2, ADAM_EPS = 0.9, 0.999, 1e-5
"""Adam's settings in SB3's PPO: torch's own decay rates, and SB3's epsilon."""

BLOCK = 16384
"""Weights whose gradient exists at a time: as many as stay in a core's cache together with their moments."""


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def products(matrix, bias, x, batch, out):  # type: ignore[no-untyped-def]
    """out[b, i] = matrix[i] . x[b] + bias[i], for b < batch. Two rows by five decisions, the paper's rollout, at a time: nothing is loaded twice."""
    n_out, n = matrix.shape
    i = 0
    while i + 2 <= n_out:
        row, next_row, start, next_start = matrix[i], matrix[i + 1], bias[i], bias[i + 1]
        b = 0
        while b + 5 <= batch:
            x0, x1, x2, x3, x4 = x[b], x[b + 1], x[b + 2], x[b + 3], x[b + 4]
            s0, s1, s2, s3, s4 = start, start, start, start, start
            t0, t1, t2, t3, t4 = next_start, next_start, next_start, next_start, next_start
            for j in range(n):
                w, u = row[j], next_row[j]
                s0 += w * x0[j]
                s1 += w * x1[j]
                s2 += w * x2[j]
                s3 += w * x3[j]
                s4 += w * x4[j]
                t0 += u * x0[j]
                t1 += u * x1[j]
                t2 += u * x2[j]
                t3 += u * x3[j]
                t4 += u * x4[j]
            out[b, i], out[b + 1, i], out[b + 2, i], out[b + 3, i], out[b + 4, i] = s0, s1, s2, s3, s4
            i1 = i + 1
            out[b, i1], out[b + 1, i1], out[b + 2, i1], out[b + 3, i1], out[b + 4, i1] = t0, t1, t2, t3, t4
            b += 5
        while b < batch:
            s0, t0 = start, next_start
            one = x[b]
            for j in range(n):
                s0 += row[j] * one[j]
                t0 += next_row[j] * one[j]
            out[b, i], out[b, i + 1] = s0, t0
            b += 1
        i += 2
    if i < n_out:
        row = matrix[i]
        for b in range(batch):
            s0 = bias[i]
            one = x[b]
            for j in range(n):
                s0 += row[j] * one[j]
            out[b, i] = s0


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy", inline="always")
def gradient_row(gradient, deltas, scale, x):  # type: ignore[no-untyped-def]
    """gradient = sum over decisions of scale * delta * x. Returns the sum of scale * delta, the gradient by the bias."""
    n, batch = len(gradient), len(deltas)
    total = np.float32(0.0)
    b = 0
    while b + 5 <= batch:
        x0, x1, x2, x3, x4 = x[b], x[b + 1], x[b + 2], x[b + 3], x[b + 4]
        d0, d1, d2 = np.float32(scale * deltas[b]), np.float32(scale * deltas[b + 1]), np.float32(scale * deltas[b + 2])
        d3, d4 = np.float32(scale * deltas[b + 3]), np.float32(scale * deltas[b + 4])
        if b == 0:
            for j in range(n):
                gradient[j] = d0 * x0[j] + d1 * x1[j] + d2 * x2[j] + d3 * x3[j] + d4 * x4[j]
        else:
            for j in range(n):
                gradient[j] += d0 * x0[j] + d1 * x1[j] + d2 * x2[j] + d3 * x3[j] + d4 * x4[j]
        total += d0 + d1 + d2 + d3 + d4
        b += 5
    if b == 0:
        gradient[:] = np.float32(0.0)
    while b < batch:
        delta = np.float32(scale * deltas[b])
        one = x[b]
        for j in range(n):
            gradient[j] += delta * one[j]
        total += delta
        b += 1
    return total


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def adam(weights, first, second, gradient, rate, root):  # type: ignore[no-untyped-def]
    """One step of Adam on some weights and their moments."""
    keep1, keep2 = np.float32(BETA1), np.float32(BETA2)
    new1, new2 = np.float32(1.0 - BETA1), np.float32(1.0 - BETA2)
    eps, pace, inverse = np.float32(ADAM_EPS), np.float32(rate), np.float32(1.0 / root)
    for j in range(len(weights)):
        g = gradient[j]
        moment = keep1 * first[j] + new1 * g
        square = keep2 * second[j] + new2 * g * g
        first[j] = moment
        second[j] = square
        weights[j] -= pace * moment / (np.sqrt(square) * inverse + eps)


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def squash(values, slopes, batch, width, gelu):  # type: ignore[no-untyped-def]
    """tanh or GELU of values[:batch, :width], in place, and its slopes there."""
    half, root = np.float32(0.5), np.float32(math.sqrt(0.5))
    peak = np.float32(1.0 / math.sqrt(2.0 * math.pi))
    for b in range(batch):
        for i in range(width):
            x = values[b, i]
            if gelu:
                below = half * (np.float32(1.0) + np.float32(math.erf(x * root)))
                values[b, i] = x * below
                slopes[b, i] = below + x * peak * np.exp(-half * x * x)
            else:
                y = np.tanh(x)
                values[b, i] = y
                slopes[b, i] = np.float32(1.0) - y * y


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def forward(weights, sizes, inputs, passed, gelu):  # type: ignore[no-untyped-def]
    """Run a tower. `inputs` (batch, sizes[0]); `passed` is filled, its last layer with the outputs as they are."""
    batch = inputs.shape[0]
    activations, slopes = passed[0], passed[1]
    offset = 0
    for layer in range(len(sizes) - 1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        given = inputs if layer == 0 else activations[layer - 1]
        bias = offset + n_in * n_out
        products(weights[offset:bias].reshape(n_out, n_in), weights[bias : bias + n_out], given, batch, activations[layer])
        if layer < len(sizes) - 2:
            squash(activations[layer], slopes[layer], batch, n_out, gelu)
        offset = bias + n_out


# Inlined, because otherwise what a process has compiled itself and what it takes from the cache round differently, and replays with them.
@njit(cache=True, fastmath=True, nogil=True, error_model="numpy", inline="always")
def backward(weights, sizes, slopes, deltas, batch):  # type: ignore[no-untyped-def]
    """Carry `deltas[-1]` (the loss by the outputs) back to all layers: deltas (layers, batch, widest) by each layer's sums."""
    layers = len(sizes) - 1
    end = 0
    for layer in range(layers):
        end += (sizes[layer] + 1) * sizes[layer + 1]
    for layer in range(layers - 1, 0, -1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        end -= (n_in + 1) * n_out
        for b in range(batch):
            deltas[layer - 1, b, :n_in] = np.float32(0.0)
        for i in range(n_out):
            row = weights[end + i * n_in : end + (i + 1) * n_in]
            for b in range(batch):
                delta = deltas[layer, b, i]
                into = deltas[layer - 1, b]
                for j in range(n_in):
                    into[j] += delta * row[j]
        for b in range(batch):
            for j in range(n_in):
                deltas[layer - 1, b, j] *= slopes[layer - 1, b, j]


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def squared_norm(sizes, inputs, activations, deltas):  # type: ignore[no-untyped-def]
    """Squared length of the gradient by all weights and biases, from products among the decisions of the batch."""
    batch = inputs.shape[0]
    total = 0.0
    for layer in range(len(sizes) - 1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        given = inputs if layer == 0 else activations[layer - 1]
        for b in range(batch):
            for c in range(b + 1):
                by_delta = 0.0
                for i in range(n_out):
                    by_delta += deltas[layer, b, i] * deltas[layer, c, i]
                by_input = 1.0
                for j in range(n_in):
                    by_input += given[b, j] * given[c, j]
                total += (1.0 if b == c else 2.0) * by_delta * by_input
    return total


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def step(weights, first, second, sizes, inputs, activations, deltas, scale, rate, root, following, passed, gradient, gelu):  # type: ignore[no-untyped-def]
    """One step of Adam on a tower, and the forward pass on the new weights.

    `first`, `second`: Adam's moments. `activations`: of `inputs`. `scale`: of the gradient, from clipping. `rate`, `root`: learning rate over the
    first, and square root of the second bias correction. `following` (batch, sizes[0]): inputs of the forward pass, which fills `passed`.
    `gradient`: room for the gradient of some rows at a time (`BLOCK`), at least of one.
    """
    outputs, slopes = passed[0], passed[1]
    batch, ahead = inputs.shape[0], following.shape[0]
    offset = 0
    by_bias = np.empty(max(sizes), np.float32)
    for layer in range(len(sizes) - 1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        given = inputs if layer == 0 else activations[layer - 1]
        taken = following if layer == 0 else outputs[layer - 1]
        bias = offset + n_in * n_out
        rows = max(1, len(gradient) // n_in)
        for start in range(0, n_out, rows):
            stop = min(n_out, start + rows)
            for i in range(start, stop):
                at = (i - start) * n_in
                by_bias[i] = gradient_row(gradient[at : at + n_in], deltas[layer, :batch, i], scale, given)
            low, high = offset + start * n_in, offset + stop * n_in
            adam(weights[low:high], first[low:high], second[low:high], gradient[: high - low], rate, root)
            low_bias, high_bias = bias + start, bias + stop
            adam(weights[low_bias:high_bias], first[low_bias:high_bias], second[low_bias:high_bias], by_bias[start:stop], rate, root)
            matrix = weights[low:high].reshape(stop - start, n_in)
            products(matrix, weights[low_bias:high_bias], taken, ahead, outputs[layer, :, start:stop])
        if layer < len(sizes) - 2:
            squash(outputs[layer], slopes[layer], ahead, n_out, gelu)
        offset = bias + n_out


@njit(cache=True, nogil=True, error_model="numpy")
def log_softmax(logits, out):  # type: ignore[no-untyped-def]
    """Logarithms of the probabilities, row by row; `logits` may be wider than `out`."""
    rows, columns = out.shape
    for b in range(rows):
        highest = logits[b, 0]
        for k in range(1, columns):
            highest = max(highest, logits[b, k])
        total = 0.0
        for k in range(columns):
            total += np.exp(logits[b, k] - highest)
        for k in range(columns):
            out[b, k] = logits[b, k] - highest - np.log(total)


@njit(cache=True, nogil=True, error_model="numpy")
def train(actor, critic, counts, inputs, actions, old, advantages, returns, following, work, settings):  # type: ignore[no-untyped-def]
    """Train on one rollout, as SB3's `PPO.train` with one mini-batch an epoch.

    Args:
        actor, critic: (weights, first moments, second moments, sizes).
        counts: int64 (1,), Adam's steps so far; counted on.
        inputs: float32 (batch, dim). actions: int64 (batch,). old: log probabilities of the actions when they were chosen.
        advantages: normalised. returns: what the value network is to say.
        following: (ahead, dim) contexts of the next rollout.
        work: (what passed the actor, spare, deltas, what passed the critic, spare, deltas, room for `step`); what passed is of `inputs` at the
            present weights.
        settings: (learning_rate, n_epochs, clip_range, ent_coef, vf_coef, max_grad_norm, target_kl; negative: none; 1 for GELU).

    Returns:
        which of the two (0: the first of `work`, 1: the spare) are now those of `following`; -1: neither, it ended before the last epoch.
    """
    learning_rate, n_epochs, clip_range, ent_coef, vf_coef, max_grad_norm, target_kl, activation = settings
    gelu = activation > 0.0
    actor_now, actor_next, actor_deltas, critic_now, critic_next, critic_deltas, gradient = work
    batch = len(actions)
    policies = actor[3][-1]
    log_probabilities = np.empty((batch, policies), np.float64)
    epochs = int(n_epochs)
    for epoch in range(epochs):
        log_softmax(actor_now[0, -1], log_probabilities)
        divergence = 0.0
        for b in range(batch):
            difference = log_probabilities[b, actions[b]] - old[b]
            divergence += (np.exp(difference) - 1.0 - difference) / batch
        if target_kl >= 0.0 and divergence > 1.5 * target_kl:
            return -1
        for b in range(batch):
            ratio = np.exp(log_probabilities[b, actions[b]] - old[b])
            advantage = advantages[b]
            clipped = min(max(ratio, 1.0 - clip_range), 1.0 + clip_range)
            by_log_probability = -advantage * ratio / batch if advantage * ratio <= advantage * clipped else 0.0
            entropy = 0.0
            for k in range(policies):
                entropy -= np.exp(log_probabilities[b, k]) * log_probabilities[b, k]
            for k in range(policies):
                probability = np.exp(log_probabilities[b, k])
                chosen = 1.0 if k == actions[b] else 0.0
                by_logit = by_log_probability * (chosen - probability)
                actor_deltas[-1, b, k] = by_logit + ent_coef / batch * probability * (log_probabilities[b, k] + entropy)
            critic_deltas[-1, b, 0] = vf_coef * 2.0 / batch * (critic_now[0, -1, b, 0] - returns[b])
        backward(actor[0], actor[3], actor_now[1], actor_deltas, batch)
        backward(critic[0], critic[3], critic_now[1], critic_deltas, batch)
        square = squared_norm(actor[3], inputs, actor_now[0], actor_deltas) + squared_norm(critic[3], inputs, critic_now[0], critic_deltas)
        scale = min(1.0, max_grad_norm / (np.sqrt(max(square, 0.0)) + 1e-6))
        counts[0] += 1
        rate = learning_rate / (1.0 - BETA1 ** counts[0])
        root = np.sqrt(1.0 - BETA2 ** counts[0])
        seen = following if epoch == epochs - 1 else inputs
        step(actor[0], actor[1], actor[2], actor[3], inputs, actor_now[0], actor_deltas, scale, rate, root, seen, actor_next, gradient, gelu)
        step(critic[0], critic[1], critic[2], critic[3], inputs, critic_now[0], critic_deltas, scale, rate, root, seen, critic_next, gradient, gelu)
        actor_now, actor_next = actor_next, actor_now
        critic_now, critic_next = critic_next, critic_now
    return epochs % 2
