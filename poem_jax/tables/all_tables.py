"""Every table by the name under which `poem eval --table` knows it."""

from poem_jax.tables import ablation, ho3d_official, main, real_world, robustness, single_view, synthetic, v2
from poem_jax.tables.result import AnyTable

TABLES: dict[str, AnyTable] = {
    table.name: table
    for table in (
        main.table,
        ablation.table,
        robustness.table,
        v2.table,
        ho3d_official.version_2,
        ho3d_official.version_3,
        single_view.table,
        real_world.table,
        synthetic.table,
    )
}


def table_named(name: str) -> AnyTable:
    """Return a table.

    Raises:
        ValueError: there is none of that name; the message lists those that there are.
    """
    if name not in TABLES:
        raise ValueError(f"--table must be one of {', '.join(TABLES)}; got {name!r}")
    return TABLES[name]
