import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher import normalizer

update = jax.jit(normalizer.update)


def test_moments_are_those_of_all_values():
    rng = np.random.default_rng(0)
    batches = [rng.normal([1.3, -50, 0], [0.05, 2, 0], (n, 5, 3)).astype(np.float32) for n in (1, 7, 100, 3)]
    state = normalizer.init(jnp.zeros(3))
    for batch in batches:
        state = update(state, jnp.asarray(batch), 200.0)
    values = np.concatenate(batches).reshape(-1, 3).astype(np.float64)
    assert state.count == len(values)
    np.testing.assert_allclose(state.mean, values.mean(0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(state.var, values.var(0), rtol=1e-4, atol=1e-9)


def test_no_cancellation_after_many_batches():
    """A narrow value far from zero, ten million samples: sums of squares in float32 would have lost the variance."""
    rng = np.random.default_rng(1)
    batch = jnp.asarray(rng.normal(100.0, 0.01, (1000, 1)), jnp.float32)
    state = normalizer.init(jnp.zeros(1)).replace(count=jnp.array(1e7), mean=jnp.array([100.0]), var=jnp.array([1e-4]))
    for _ in range(50):
        state = update(state, batch, 200.0)
    np.testing.assert_allclose(state.var, [1e-4], rtol=0.02)


def test_normalize_by_hand():
    state = normalizer.NormalizerState(count=jnp.array(4.0), mean=jnp.array([1.0, 0.0, 0.0]), var=jnp.array([4.0, 1e-8, 1.0]))
    got = normalizer.normalize(state, jnp.array([[3.0, 0.02, 1000.0]]), eps=0.01, clip=5.0, input_clip=4.5)
    # (3 - 1) / 2; 0.02 / max(1e-4, 0.01); 1000 clipped to 4.5
    np.testing.assert_allclose(got, [[1.0, 2.0, 4.5]], rtol=1e-6)
    got = normalizer.normalize(state, jnp.array([[99.0, -9.0, 0.0]]), eps=0.01, clip=5.0, input_clip=200.0)
    np.testing.assert_allclose(got, [[5.0, -5.0, 0.0]])


def test_sums_of_float16_values_do_not_overflow():
    values = jnp.linspace(90, 110, 3000, dtype=jnp.float16)[:, None]
    state = update(normalizer.init(values[0]), values, 200.0)
    exact = np.asarray(values, np.float64)
    np.testing.assert_allclose([state.mean[0], state.var[0]], [exact.mean(), exact.var()], rtol=1e-4)


def test_values_are_clipped_before_they_count():
    state = update(normalizer.init(jnp.zeros(1)), jnp.array([[1e9], [0.0]]), 200.0)
    np.testing.assert_allclose(state.mean, [100.0])


def test_nothing_seen_is_the_identity():
    np.testing.assert_allclose(
        normalizer.normalize(normalizer.init(jnp.zeros(2)), jnp.array([0.5, -2.0]), 0.01, 5.0, 200.0), [0.5, -2]
    )


def test_only_valid_values_are_seen():
    values = jnp.array([[1.0, 2.0], [jnp.nan, 5.0], [3.0, 8.0]])
    valid = jnp.array([True, False, True])
    state = update(normalizer.init(jnp.zeros(2)), values, 200.0, valid)
    expected = update(normalizer.init(jnp.zeros(2)), values[valid], 200.0)
    jax.tree.map(np.testing.assert_array_equal, state, expected)
    jax.tree.map(np.testing.assert_array_equal, update(state, values, 200.0, jnp.zeros(3, bool)), state)


def test_a_tree_is_normalized_leaf_by_leaf():
    """Each float leaf has the moments that it would have alone, whatever its shape; other leaves pass through."""
    random = np.random.default_rng(0)
    values = {
        "vector": random.normal(size=(4, 5, 3)).astype(np.float32),
        "image": np.ones((4, 5, 2, 2, 1), np.uint8),
        "field": [random.normal(size=(4, 5, 2, 2)).astype(np.float32), np.ones((4, 5), np.float32)],
    }
    valid = np.arange(20).reshape(4, 5) % 3 > 0
    state = normalizer.init(jax.tree.map(lambda x: x[0, 0], values))
    state = update(state, values, 200.0, valid)
    assert state["image"] is None
    for leaf, moments in ((values["vector"], state["vector"]), (values["field"][0], state["field"][0])):
        flat = np.asarray(leaf).reshape(20, -1)[valid.reshape(-1)]
        np.testing.assert_allclose(moments.mean.reshape(-1), flat.mean(0), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(moments.var.reshape(-1), flat.var(0), rtol=1e-5)
    rows = update(normalizer.init(jnp.zeros(3)), values["vector"], 200.0, jnp.array([True, False, True, True]))
    assert float(rows.count) == 15
    normalize = jax.jit(normalizer.normalize)
    result = normalize(state, values, 0.01, 5.0, 200.0)
    assert result["image"].dtype == jnp.uint8
    alone = normalize(state["vector"], values["vector"], 0.01, 5.0, 200.0)
    np.testing.assert_array_equal(result["vector"], alone)
    assert abs(np.mean(np.asarray(result["field"][0])[valid])) < 1e-6
