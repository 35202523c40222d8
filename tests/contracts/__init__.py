"""What every implementation of an interface must do: inherit a suite, name the object, and it is tested.

    class TestUniform(RandomVectorContract):
        def law(self):
            return pc.Uniform([-1.0, 0.0], [2.0, 0.5])

Suites compare with samples by five standard errors under fixed keys, so they never fail by chance.
"""
