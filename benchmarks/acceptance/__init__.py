"""Acceptance table of the Husky model: measured values with limits, and wrong models that must exceed these limits.

*Subject*: the robot that is measured, correct or deliberately wrong. *Edit*: a change to the `MjSpec` before it is
compiled, which makes a wrong model. *Chi*: track ratio, the effective track divided by the geometric one. Letters of
the row ids: A composition, B scrubbing on a plane, C static friction and stalling, D driving, E ground from the
pipeline, P convex parts. Read chi together with B4 to B6: a hopping model can have a plausible chi, and a model with a
pyramidal friction cone has the right chi with a torque 23 % too low.
"""
