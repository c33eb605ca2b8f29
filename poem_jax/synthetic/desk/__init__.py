"""Two hands of one person above a desk, filmed by four cameras: the videos of `poem demo`.

World frame, metres: the desk's top is the plane z = 0, z points up, y away from the person, who sits at
negative y. All of it is a function of time, and the same on every run.
"""
