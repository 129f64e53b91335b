"""Ground frame of the UAV tracker: ego-motion over the ground plane, localisation, photometric gain and road map.

Ground units: metres where telemetry gives the height, else scaled so that the target is as long as a car.
Ground axes: X, Y on the plane; with telemetry X is north and Y east, without it X is right and Y down in the
first image. Angles are atan2(Y, X).
"""
