import numpy as np

from wavebatch.core.order import EvenSample


def test_an_even_sample_is_every_nth_row_however_they_come(rng):
    columns = {"value": rng.normal(size=5000), "place": rng.normal(size=(5000, 2))}
    for pieces in (1, 77, 5000):
        sample = EvenSample(300)
        for rows in np.array_split(np.arange(5000), pieces):
            sample.add({name: values[rows] for name, values in columns.items()})
        assert sample.seen == 5000 and sample.step == 32
        for name, values in columns.items():
            assert np.array_equal(sample.read()[name], values[:: sample.step])
