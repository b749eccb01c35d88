import subprocess
import sys

WITHOUT_PANDAS = """
import sys
from serve_app.runtime.worker_start import import_serve

import_serve()
print({"pandas", "pyarrow", "sqlalchemy"} & sys.modules.keys())
import pandas
from ray.serve._private import utils
print(utils.pd)
"""


def test_ray_serve_is_imported_without_pandas_which_others_can_import() -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT_PANDAS], capture_output=True, text=True, timeout=120)
    assert done.stdout.split("\n") == ["set()", "None", ""], done.stderr
