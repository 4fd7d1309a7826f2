#!/bin/sh
# Makes .venv in the checkout and installs the plugin editable with everything it needs.
set -eu
python=$(sh scripts/find_python.sh)
command -v c++ >/dev/null 2>&1 || command -v g++ >/dev/null 2>&1 || {
    echo "A C++ compiler is needed to build pybullet, for example: apt install g++. Without one: docs/installation.md" >&2
    exit 1
}
right='(3, 12) <= sys.version_info < (3, 14)'
if [ -n "${PYTHON:-}" ]; then # named: the one that is there must be of the same version
    right="sys.version_info[:2] == $("$python" -c 'import sys; print(tuple(sys.version_info[:2]))')"
fi
if ! .venv/bin/python -c "import sys; sys.exit(not $right)" >/dev/null 2>&1; then
    rm -rf .venv
    "$python" -m venv .venv
fi
if command -v uv >/dev/null 2>&1; then
    uv=uv
else
    .venv/bin/python -m pip install --quiet --disable-pip-version-check uv
    uv=.venv/bin/uv
fi
echo "installing with $python (torch and pybullet take some minutes the first time)"
# Compiled now: where PYTHONDONTWRITEBYTECODE is set every command would compile LeRobot anew (13 s instead of 5).
"$uv" pip install --compile-bytecode --python .venv/bin/python --constraint constraints.txt --editable '.[dev]'

echo "compiling the renderers (once)"
.venv/bin/python -c '
from lerobot_lansar.desk import Desk
for renderer in ("gl", "tiny"):
    with Desk("D", renderer=renderer): pass
' >/dev/null
touch .venv/.installed
