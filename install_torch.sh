#!/bin/sh
# Installs torch by the pip command that is given, before anything else asks for it: on Linux without an NVIDIA GPU the
# CPU build, whose index is asked first. TORCH_INDEX=URL names another index; an empty one leaves the choice to pip.
set -eu
cpu=https://download.pytorch.org/whl/cpu
python=$(dirname "$1")/python
asks() { "$python" -c "import sys, urllib.request as u; u.urlopen(sys.argv[1] + '/torch/', timeout=5)" "$1" 2>/dev/null; }
if [ "${TORCH_INDEX-auto}" != auto ]; then
    index=$TORCH_INDEX
elif [ "$(uname -s)" != Linux ] || nvidia-smi >/dev/null 2>&1; then
    index=
elif asks "$cpu"; then
    index=$cpu
else
    echo "No NVIDIA GPU here, but $cpu does not answer: pip takes torch from its own places, with CUDA about 3 GB." >&2
    index=
fi
if [ -n "$index" ]; then
    echo "torch from $index: without CUDA about 200 MB are downloaded (TORCH_INDEX= leaves the choice to pip)." >&2
    "$@" --extra-index-url "$index" torch
else
    "$@" torch
fi
