import numpy as np

from poem_jax.synthetic.backgrounds import SIZE, make_backgrounds


def test_the_bank_is_a_function_of_its_seed():
    bank = make_backgrounds(4, 6)
    assert bank.shape == (6, SIZE, SIZE, 3)
    assert bank.dtype == np.uint8
    np.testing.assert_array_equal(make_backgrounds(4, 2), bank[:2])
    assert not np.array_equal(make_backgrounds(5, 2), bank[:2])


def test_no_background_is_flat():
    bank = make_backgrounds(0, 12)
    assert bank.std((1, 2)).max(-1).min() > 4
