"""Print the coverage of each package from the data that `make coverage` has collected.

    make coverage

Lines run in other processes, as by the tests of whole programs, are not in the data.
"""

from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent / "gateway"


def package_of(path: Path) -> str:
    """Return the package of a file."""
    inside = path.relative_to(ROOT).parts
    return inside[0] if len(inside) > 1 else "top level"


def main() -> None:
    """Print a table with one line for each package."""
    from coverage import Coverage

    measured = Coverage()
    measured.load()
    lines, covered = Counter[str](), Counter[str]()
    for name in measured.get_data().measured_files():
        if not name.endswith(".py"):
            continue  # a template, whose lines are compiled to Python
        _, statements, _, missing, _ = measured.analysis2(name)
        for package in (package_of(Path(name)), "all"):
            lines[package] += len(statements)
            covered[package] += len(statements) - len(missing)
    print(f"{'package':<12}{'statements':>12}{'covered':>9}")
    for package in sorted(lines, key=lambda name: (name == "all", name)):
        share = covered[package] / (lines[package] or 1)
        print(f"{package:<12}{lines[package]:>12}{share:>9.0%}")


if __name__ == "__main__":
    main()
