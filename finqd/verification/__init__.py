"""Verification: cases with closed-form or published answers, run through the same code as a grasp (`finqd verify`)."""
