"""Parts of the ground-plane tracker: ego-motion, appearance, road and the motion of one car.

Ground units: metres where telemetry gives the height, else chosen so that the target is a car's length long.
Ground axes: X, Y on the plane; with telemetry X is north and Y east, without it X is right and Y down in the
first picture. Angles are atan2(Y, X).
"""
