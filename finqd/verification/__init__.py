"""Verification: cases with closed-form or published answers (`finqd verify`).

All run through scene, stepper and contact of a grasp, but for those of elements alone (patch, rotation, order in the
mesh, Cook), which assemble and solve by themselves.
"""
