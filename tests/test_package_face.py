"""What `import iga_drake` gives."""

import importlib
import subprocess
import sys

import pytest

import iga_drake


def test_every_name_is_the_one_of_its_home():
    for name, home in iga_drake._HOMES.items():
        assert getattr(iga_drake, name) is getattr(importlib.import_module(home), name)
    assert set(dir(iga_drake)) == set(iga_drake.__all__)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'Epsiode'"):
        iga_drake.Epsiode  # noqa: B018


def test_importing_the_package_loads_nothing_heavy():
    code = (
        "import sys, iga_drake\n"
        "heavy = {'torch', 'pydrake', 'open3d', 'numpy'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
