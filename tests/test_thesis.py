"""`make thesis`: every step at tiny sizes, on a machine whose network is cut off."""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[1] / "scripts/thesis.py"

CUT_OFF = """
import os, socket

def local(host):
    known = (None, "", b"", "localhost", b"localhost", socket.gethostname())
    return host in known or str(host).startswith(("127.", "::1"))

def refuse(host):
    with open(os.environ["ASKED"], "a") as file:
        file.write(f"{host}\\n")
    raise OSError("the network is cut off")

connect, lookup = socket.socket.connect, socket.getaddrinfo

def guarded_connect(self, address):
    if self.family in (socket.AF_INET, socket.AF_INET6) and not local(address[0]):
        refuse(address[0])
    return connect(self, address)

def guarded_lookup(host, *arguments, **options):
    if not local(host):
        refuse(host)
    return lookup(host, *arguments, **options)

socket.socket.connect, socket.getaddrinfo = guarded_connect, guarded_lookup
"""
"""Runs in every Python process first; whoever asks the network is written down."""


def load():
    spec = importlib.util.spec_from_file_location("thesis", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_whole_line_runs_without_a_network(tmp_path):
    (tmp_path / "sitecustomize.py").write_text(CUT_OFF)
    asked = tmp_path / "asked"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "ASKED": str(asked), "HF_HOME": str(tmp_path / "hf")}
    knock = "import socket; socket.create_connection(('192.0.2.1', 80))"
    subprocess.run([sys.executable, "-c", knock], env=environment, capture_output=True)
    assert asked.read_text() == "192.0.2.1\n", "whoever asks is written down"
    asked.unlink()
    command = [sys.executable, SCRIPT, "--dry_run", "--pictures", "--workers=1", f"--output_dir={tmp_path / 'out'}"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout[-3000:]
    result = json.loads((tmp_path / "out/result.json").read_text())
    assert {name: found["chains"] for name, found in result["evaluations"].items()} == {"recommended": 2, "thesis": 2}
    assert (tmp_path / "out/report/report.html").is_file()
    for name in ("recommended", "thesis"):
        policy = json.loads((tmp_path / f"out/train/{name}/checkpoints/last/pretrained_model/config.json").read_text())
        assert policy["use_images"]
        assert policy["orientation"] == ("sincos" if name == "recommended" else "euler")
    command.remove("--pictures")
    refused = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert refused.returncode == 2
    assert 'holds a run with {"pictures": true' in refused.stderr
    assert not asked.exists(), asked.read_text()


def test_a_dataset_taken_along_is_learned_from_instead_of_a_recording(tmp_path, monkeypatch, capsys):
    thesis, commands = load(), []
    monkeypatch.setattr(thesis, "run", lambda title, log, seconds, *command: commands.append(command))
    options = argparse.Namespace(minutes=60, output_dir=tmp_path / "out", dataset=tmp_path / "taken", workers=2)
    options.dry_run, options.hours, options.device, options.pictures = True, None, "cpu", False
    run = thesis.Thesis(options)
    run.record()
    assert [command[0] for command in commands] == ["lansar-record", "lansar-convert"], "there is none yet"
    assert "--cameras=[]" in commands[0]
    assert "--embed=true" not in commands[1]
    (tmp_path / "taken/meta").mkdir(parents=True)
    (tmp_path / "taken/meta/info.json").touch()
    commands.clear()
    run.record()
    assert commands == []
    run.train("thesis", 100)
    assert {f"--dataset.root={tmp_path / 'taken'}", "--config_path=configs/thesis/no_images.yaml"} <= {*commands[0]}
    monkeypatch.setattr(sys, "argv", ["thesis.py", f"--dataset={tmp_path / 'nowhere'}"])
    with pytest.raises(SystemExit):
        thesis.main()
    assert "no meta/info.json" in capsys.readouterr().err
