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

GROUP = 5
"""Decisions that go through a row of weights together: the paper's rollout. A batch is filled up to a multiple of it by rows of zeros."""


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy", inline="always")
def tanh(x):  # type: ignore[no-untyped-def]
    """To three units in the last place, by the quotient of polynomials that Eigen uses: unlike the C library's it is computed for many at once."""
    x = min(max(x, np.float32(-7.90531110763549805)), np.float32(7.90531110763549805))
    y = x * x
    above = y * np.float32(-2.76076847742355e-16) + np.float32(2.00018790482477e-13)
    above = above * y + np.float32(-8.60467152213735e-11)
    above = above * y + np.float32(5.12229709037114e-08)
    above = above * y + np.float32(1.48572235717979e-05)
    above = above * y + np.float32(6.37261928875436e-04)
    above = above * y + np.float32(4.89352455891786e-03)
    below = y * np.float32(1.19825839466702e-06) + np.float32(1.18534705686654e-04)
    below = below * y + np.float32(2.26843463243900e-03)
    below = below * y + np.float32(4.89352518554385e-03)
    return x * above / below


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def squash(values, slopes, width, gelu):  # type: ignore[no-untyped-def]
    """tanh or GELU of values[:, :width], in place, and its slopes there."""
    half, one, root = np.float32(0.5), np.float32(1.0), np.float32(math.sqrt(0.5))
    peak = np.float32(1.0 / math.sqrt(2.0 * math.pi))
    for b in range(values.shape[0]):
        if gelu:
            for i in range(width):
                x = values[b, i]
                below = half * (one + np.float32(math.erf(x * root)))
                values[b, i] = x * below
                slopes[b, i] = below + x * peak * np.exp(-half * x * x)
        else:
            for i in range(width):
                y = tanh(values[b, i])
                values[b, i] = y
                slopes[b, i] = one - y * y


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy", inline="always")
def product(row, bias, x, b, out, i):  # type: ignore[no-untyped-def]
    """out[b + k, i] = row . x[b + k] + bias, for k < GROUP."""
    x0, x1, x2, x3, x4 = x[b], x[b + 1], x[b + 2], x[b + 3], x[b + 4]
    s0, s1, s2, s3, s4 = bias, bias, bias, bias, bias
    for j in range(len(row)):
        w = row[j]
        s0 += w * x0[j]
        s1 += w * x1[j]
        s2 += w * x2[j]
        s3 += w * x3[j]
        s4 += w * x4[j]
    out[b, i], out[b + 1, i], out[b + 2, i], out[b + 3, i], out[b + 4, i] = s0, s1, s2, s3, s4


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def forward(weights, sizes, inputs, passed, gelu):  # type: ignore[no-untyped-def]
    """Run a tower. `inputs` (batch, sizes[0]); `passed` is filled, its last layer with the outputs as they are."""
    activations, slopes = passed[0], passed[1]
    offset = 0
    for layer in range(len(sizes) - 1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        given = inputs if layer == 0 else activations[layer - 1]
        bias = offset + n_in * n_out
        for i in range(n_out):
            row = weights[offset + i * n_in : offset + (i + 1) * n_in]
            for b in range(0, inputs.shape[0], GROUP):
                product(row, weights[bias + i], given, b, activations[layer], i)
        if layer < len(sizes) - 2:
            squash(activations[layer], slopes[layer], n_out, gelu)
        offset = bias + n_out


# Inlined, because otherwise what a process has compiled itself and what it takes from the cache round differently, and replays with them.
@njit(cache=True, fastmath=True, nogil=True, error_model="numpy", inline="always")
def backward(weights, sizes, slopes, deltas):  # type: ignore[no-untyped-def]
    """Carry `deltas[-1]` (the loss by the outputs) back to all layers: deltas (layers, batch, widest) by each layer's sums. Two rows at a time."""
    layers = len(sizes) - 1
    end = 0
    for layer in range(layers):
        end += (sizes[layer] + 1) * sizes[layer + 1]
    for layer in range(layers - 1, 0, -1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        end -= (n_in + 1) * n_out
        for b in range(0, deltas.shape[1], GROUP):
            i0, i1, i2, i3, i4 = (
                deltas[layer - 1, b],
                deltas[layer - 1, b + 1],
                deltas[layer - 1, b + 2],
                deltas[layer - 1, b + 3],
                deltas[layer - 1, b + 4],
            )
            for j in range(n_in):
                i0[j], i1[j], i2[j], i3[j], i4[j] = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for i in range(0, n_out, 2):
                last = i + 1 == n_out
                k = i if last else i + 1  # of an odd number of rows the last one has none beside it
                one, two = weights[end + i * n_in : end + (i + 1) * n_in], weights[end + k * n_in : end + (k + 1) * n_in]
                d = deltas[layer]
                p0, p1, p2, p3, p4 = d[b, i], d[b + 1, i], d[b + 2, i], d[b + 3, i], d[b + 4, i]
                kept = np.float32(0.0) if last else np.float32(1.0)
                q0, q1, q2, q3, q4 = kept * d[b, k], kept * d[b + 1, k], kept * d[b + 2, k], kept * d[b + 3, k], kept * d[b + 4, k]
                for j in range(n_in):
                    u, v = one[j], two[j]
                    i0[j] += p0 * u + q0 * v
                    i1[j] += p1 * u + q1 * v
                    i2[j] += p2 * u + q2 * v
                    i3[j] += p3 * u + q3 * v
                    i4[j] += p4 * u + q4 * v
            for c in range(b, b + GROUP):
                for j in range(n_in):
                    deltas[layer - 1, c, j] *= slopes[layer - 1, c, j]


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


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy", inline="always")
def learn(row, first, second, before, deltas, x, i, y, bias, out, pace, eps):  # type: ignore[no-untyped-def]
    """One step of Adam on a row of weights and, on what they become, the products with the decisions that come next: all for one visit of memory.

    The moments are kept divided by 1 - BETA1 and 1 - BETA2, which saves two multiplications; `pace` and `eps` make up for it.

    Args:
        row, first, second: (n,) weights and their moments.
        before: (n,) gradient by other decisions than these.
        deltas, x: (GROUP, >= n) of the decisions trained on; deltas of this row in column `i`.
        y: (GROUP, >= n) what comes next; its products with the row, plus bias, go to out[:, i].
    """
    keep1, keep2 = np.float32(BETA1), np.float32(BETA2)
    d0, d1, d2, d3, d4 = deltas[0, i], deltas[1, i], deltas[2, i], deltas[3, i], deltas[4, i]
    x0, x1, x2, x3, x4 = x[0], x[1], x[2], x[3], x[4]
    y0, y1, y2, y3, y4 = y[0], y[1], y[2], y[3], y[4]
    s0, s1, s2, s3, s4 = bias, bias, bias, bias, bias
    for j in range(len(row)):
        g = before[j] + d0 * x0[j] + d1 * x1[j] + d2 * x2[j] + d3 * x3[j] + d4 * x4[j]
        moment = keep1 * first[j] + g
        square = keep2 * second[j] + g * g
        first[j] = moment
        second[j] = square
        w = row[j] - pace * moment / (np.sqrt(square) + eps)
        row[j] = w
        s0 += w * y0[j]
        s1 += w * y1[j]
        s2 += w * y2[j]
        s3 += w * y3[j]
        s4 += w * y4[j]
    out[0, i], out[1, i], out[2, i], out[3, i], out[4, i] = s0, s1, s2, s3, s4


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def step(weights, first, second, sizes, inputs, activations, deltas, scale, pace, eps, following, passed, gradient, gelu):  # type: ignore[no-untyped-def]
    """One step of Adam on a tower, and the forward pass on the new weights.

    `first`, `second`: Adam's moments. `activations`: of `inputs`. `scale`: of the gradient, from clipping. `pace`, `eps`: see `learn`. `following`
    (batch, sizes[0]): inputs of the forward pass, which fills `passed`. `gradient`: room for that of a row, of zeros.
    """
    outputs, slopes = passed[0], passed[1]
    batch = inputs.shape[0]
    last = batch - GROUP
    offset = 0
    for layer in range(len(sizes) - 1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        given = inputs if layer == 0 else activations[layer - 1]
        taken = following if layer == 0 else outputs[layer - 1]
        bias = offset + n_in * n_out
        own = deltas[layer]
        before = gradient[:n_in]
        for b in range(batch):
            for i in range(n_out):
                own[b, i] *= scale
        for i in range(n_out):
            if last:
                for j in range(n_in):
                    before[j] = np.float32(0.0)
                for b in range(last):
                    delta, x = own[b, i], given[b]
                    for j in range(n_in):
                        before[j] += delta * x[j]
            g = np.float32(0.0)
            for b in range(batch):
                g += own[b, i]
            at = bias + i
            moment = np.float32(BETA1) * first[at] + g
            square = np.float32(BETA2) * second[at] + g * g
            first[at], second[at] = moment, square
            weights[at] -= pace * moment / (np.sqrt(square) + eps)
            low, high = offset + i * n_in, offset + (i + 1) * n_in
            row = weights[low:high]
            learn(
                row,
                first[low:high],
                second[low:high],
                before,
                own[last:],
                given[last:],
                i,
                taken[last:],
                weights[at],
                outputs[layer, last:],
                pace,
                eps,
            )
            for b in range(0, last, GROUP):
                product(row, weights[at], taken, b, outputs[layer], i)
        if layer < len(sizes) - 2:
            squash(outputs[layer], slopes[layer], n_out, gelu)
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
        backward(actor[0], actor[3], actor_now[1], actor_deltas)
        backward(critic[0], critic[3], critic_now[1], critic_deltas)
        square = squared_norm(actor[3], inputs, actor_now[0], actor_deltas) + squared_norm(critic[3], inputs, critic_now[0], critic_deltas)
        scale = np.float32(min(1.0, max_grad_norm / (np.sqrt(max(square, 0.0)) + 1e-6)))
        counts[0] += 1
        # Of Adam as published: learning_rate * moment / (1 - BETA1^t) / (sqrt(square / (1 - BETA2^t)) + ADAM_EPS).
        root = np.sqrt((1.0 - BETA2 ** counts[0]) / (1.0 - BETA2))
        pace = np.float32(learning_rate * (1.0 - BETA1) / (1.0 - BETA1 ** counts[0]) * root)
        eps = np.float32(ADAM_EPS * root)
        seen = following if epoch == epochs - 1 else inputs
        step(actor[0], actor[1], actor[2], actor[3], inputs, actor_now[0], actor_deltas, scale, pace, eps, seen, actor_next, gradient, gelu)
        step(critic[0], critic[1], critic[2], critic[3], inputs, critic_now[0], critic_deltas, scale, pace, eps, seen, critic_next, gradient, gelu)
        actor_now, actor_next = actor_next, actor_now
        critic_now, critic_next = critic_next, critic_now
    return epochs % 2
