#!/bin/sh
# Prints the path of a Python 3.12 or 3.13 that really runs: pyenv's shims exist for versions that are not selected.
works() {
    "$1" -c 'import sys, venv, ensurepip; sys.exit(not (3, 12) <= sys.version_info < (3, 14))' >/dev/null 2>&1
}
for candidate in \
    ${PYTHON:+"$PYTHON"} python3.12 python3.13 python3 python \
    "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.12*/bin/python3 \
    "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.13*/bin/python3 \
    "$HOME"/.local/share/uv/python/cpython-3.1[23]*/bin/python3 \
    /opt/homebrew/bin/python3.1[23] /usr/local/bin/python3.1[23]; do
    if works "$candidate"; then
        "$candidate" -c 'import sys; print(sys.executable)'
        exit 0
    fi
    if [ -n "$PYTHON" ]; then
        echo "PYTHON=$PYTHON does not run, is not 3.12 or 3.13, or lacks venv." >&2
        exit 1
    fi
done
cat >&2 <<'MESSAGE'
No Python 3.12 or 3.13 was found (with its venv module). Install one, for example
    apt install python3.12 python3.12-venv python3.12-dev     or     pyenv install 3.12
and, if it is not on your PATH, name it: make PYTHON=/path/to/python3.12 ...
MESSAGE
exit 1
