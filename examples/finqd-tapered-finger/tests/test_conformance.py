from finqd.checks import parametrize_with_checks


@parametrize_with_checks(distribution="finqd-tapered-finger")
def test_conformance(check, kind, name):
    check(kind, name)
