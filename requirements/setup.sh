#!/usr/bin/env bash
# Finds Pythons and makes the virtual environments .venv/py311 and .venv/py313 from the lock files beside this script.
#
#   setup.sh find VERSION     print the interpreter of that version; exit code 3 when there is none
#   setup.sh python VERSION   make the environment if it is missing or outdated, print its interpreter
#   setup.sh blender PROGRAM  install what tests need in that Blender beside its own Python, print the folder
#   setup.sh browser          unpack a browser that needs no window, and three.js, into .venv/browser; print the folder
#   setup.sh slurm            install Slurm, which the tests of the farm scripts start on this machine
#   setup.sh lock [OPTION..]  rewrite the lock files (options go to `uv pip compile`, for example --upgrade)
#
# VERSION is 3.13, 3.11 or newest. LTSH_PYTHON_313 and LTSH_PYTHON_311 name an interpreter, or say "none": that
# version is then treated as absent.
# Only the answer goes to stdout. An environment counts as made by its stamp alone, which is written last.
# Runs on bash 3.2 (macOS) too.
set -euo pipefail
unset PYTHONHOME PYTHONPATH
: "${HOME:=$(cd ~ && pwd)}"

versions="3.13 3.11" # newest first; each has requirements/py<version>.txt
uv_requirement="uv==0.13.8"
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
environments=$(dirname "$here")/.venv

# What bpy's shared library needs beyond a minimal Debian 12 or 13.
debian_libraries="libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libice6 libxext6 libgl1"

say() { printf 'setup: %s\n' "$*" >&2; }
fail() { say "$@"; exit 1; }

# The time limit needs GNU `timeout`; without it (macOS) the command runs unlimited.
limited() {
    local seconds=$1
    shift
    if command -v timeout >/dev/null 2>&1; then timeout -k 10 "$seconds" "$@"; else "$@"; fi
}

# ---- interpreters

# Every place where python$1 may lie, best first. A name on PATH can be a pyenv shim that refuses to run, so
# the installations behind the shims are listed too.
candidates() {
    local version=$1 home directory
    type -aP "python$version" python3 python || true
    home=$(getent passwd "$(id -u)" 2>/dev/null | cut -d: -f6 || true)
    {
        printf '%s\n' "${PYENV_ROOT:-}" "$HOME/.pyenv" "${home:-$HOME}/.pyenv"
        printf '%s' "$PATH" | tr ':' '\n' | sed -n 's:/shims/*$::p'
    } | awk 'NF && !seen[$0]++' | while IFS= read -r directory; do
        newest_first "$directory/versions/$version"*/bin/python"$version"
    done
    for directory in "${UV_PYTHON_INSTALL_DIR:-}" "${XDG_DATA_HOME:-$HOME/.local/share}/uv/python" \
        "${home:-$HOME}/.local/share/uv/python"; do
        if [ -n "$directory" ]; then newest_first "$directory"/cpython-"$version"*/bin/python"$version"; fi
    done
    for directory in "$HOME/.local" /usr/local /usr /opt/homebrew /opt/* /opt/python/* \
        "/Library/Frameworks/Python.framework/Versions/$version"; do
        printf '%s\n' "$directory/bin/python$version"
    done
}

newest_first() { printf '%s\n' "$@" | sort -Vr; }

# "<version> <yes|no: can make environments> <interpreter behind shims and environments>" of one candidate.
interrogate() {
    limited 20 "$1" -c '
import importlib.util, sys
able = all(importlib.util.find_spec(name) for name in ("venv", "ensurepip"))
print("%d.%d" % sys.version_info[:2], "yes" if able else "no", getattr(sys, "_base_executable", "") or sys.executable)
' 2>/dev/null </dev/null || true
}

find_python() {
    local version=$1 chosen candidate found able path fallback=""
    chosen=$(eval "printf '%s' \"\${LTSH_PYTHON_${version//./}:-}\"")
    [ "$chosen" != none ] || return 3
    if [ -n "$chosen" ]; then
        read -r found able path <<<"$(interrogate "$chosen")"
        [ "$found" = "$version" ] ||
            fail "LTSH_PYTHON_${version//./} is $chosen, which answers '${found:-nothing}'; expected Python $version"
        printf '%s\n' "$path"
        return
    fi
    while IFS= read -r candidate; do
        [ -x "$candidate" ] || continue
        read -r found able path <<<"$(interrogate "$candidate")"
        [ "$found" = "$version" ] && [ -x "$path" ] || continue
        if [ "$able" = yes ]; then
            printf '%s\n' "$path"
            return
        fi
        fallback=${fallback:-$path}
    done < <(candidates "$version" | awk '!seen[$0]++')
    [ -n "$fallback" ] || return 3
    printf '%s\n' "$fallback"
}

# The newest version that has an interpreter, for "newest"; otherwise the version itself, if it is known.
resolve() {
    local version status
    case " $versions newest " in *" $1 "*) ;; *) fail "unknown version '$1', expected one of: $versions newest" ;; esac
    if [ "$1" != newest ]; then
        printf '%s\n' "$1"
        return
    fi
    for version in $versions; do
        status=0
        find_python "$version" >/dev/null || status=$?
        if [ "$status" -eq 0 ]; then
            printf '%s\n' "$version"
            return
        fi
        [ "$status" -eq 3 ] || return "$status"
    done
    say "no Python found that a Blender module exists for; looked for: $versions"
    say "install one (Debian 13: apt-get install python3 python3-venv; macOS: brew install python@3.13;"
    say "anywhere: pyenv install 3.13 or uv python install 3.13) or name it: LTSH_PYTHON_313=/path/to/python3.13"
    return 3
}

# ---- environments

# Installs Debian packages where that is possible without asking, else prints the line to type.
install_packages() {
    local what=$1
    shift
    if ! command -v apt-get >/dev/null 2>&1; then
        fail "$what; install them with this system's package manager (on Debian and Ubuntu they are: $*)"
    fi
    if [ "$(id -u)" -ne 0 ]; then
        say "$what; install them with:"
        say "  sudo apt-get update && sudo apt-get install -y --no-install-recommends $*"
        exit 1
    fi
    say "$what; installing $*"
    {
        apt-get -qq update && DEBIAN_FRONTEND=noninteractive apt-get -qq install -y --no-install-recommends "$@"
    } >/dev/null </dev/null || fail "apt-get could not install: $*; see its messages above"
}

# Slurm's programs; its services stay off, the tests start them themselves.
install_slurm() {
    PATH=$PATH:/usr/sbin
    if command -v munged && command -v slurmctld && command -v slurmd && command -v sbatch; then return; fi >/dev/null
    RUNLEVEL=1 install_packages "Slurm is not there" munge slurmctld slurmd slurm-client
}

# Changes whenever the environment has to be made again: other pins, other interpreter, other place.
stamp_of() {
    "$1" - "$here/$2.txt" "$environments/$2" <<'PYTHON'
import hashlib, sys
with open(sys.argv[1], "rb") as lock:
    print(hashlib.sha256(lock.read() + repr((sys.version, sys.executable, sys.argv[2])).encode()).hexdigest())
PYTHON
}

import_error() { limited 300 "$1" -c 'import bpy, numpy, OpenEXR, scipy' 2>&1 >/dev/null </dev/null | tail -n 1; }

check_imports() {
    local python=$1 message missing
    message=$(import_error "$python") && return
    case $message in *"cannot open shared object file"*) ;; *) fail "bpy was installed but fails: ${message:-no message}" ;; esac
    missing=$(printf '%s' "$message" | sed 's/: cannot open.*//; s/.*: //')
    # shellcheck disable=SC2086 # a list of words
    install_packages "Blender's module needs system libraries ($missing is the first one missing)" $debian_libraries
    message=$(import_error "$python") || fail "bpy still fails after installing libraries: ${message:-no message}"
}

make_environment() {
    local version=$1 name=py${1//./} python directory stamp able
    python=$(find_python "$version") || return
    directory=$environments/$name
    stamp=$(stamp_of "$python" "$name")
    mkdir -p "$environments"
    # Two runs at once: the second one waits, then finds the work done.
    exec 9>"$environments/.lock"
    if command -v flock >/dev/null 2>&1; then flock 9; fi
    if [ "$(cat "$directory/ltsh-stamp" 2>/dev/null)" != "$stamp" ]; then
        read -r _ able _ <<<"$(interrogate "$python")"
        if [ "$able" != yes ]; then
            install_packages "$python cannot make virtual environments" "python$version-venv"
        fi
        say "making $directory with $python (about 1.2 GB; some minutes)"
        "$python" -m venv --clear "$directory" >&2
        "$directory/bin/python" -m pip install --quiet --disable-pip-version-check --no-input --no-deps \
            --only-binary :all: --require-hashes -r "$here/$name.txt" >&2 </dev/null ||
            fail "pip could not install requirements/$name.txt for $python; see its messages above"
        check_imports "$directory/bin/python"
        printf '%s\n' "$stamp" >"$directory/ltsh-stamp.new"
        mv "$directory/ltsh-stamp.new" "$directory/ltsh-stamp"
        say "$directory is ready"
    fi
    exec 9>&-
    printf '%s\n' "$directory/bin/python"
}

# ---- the browser of the tests of pages

# npm's packages of browser/package-lock.json. One of them holds Chromium, its software for drawing, the libraries that
# it needs and a font, each compressed.
make_browser() {
    local directory=$environments/browser stamp
    if ! { command -v node && command -v npm; } >/dev/null 2>&1; then
        install_packages "node and npm are not there" nodejs npm
    fi
    mkdir -p "$environments"
    exec 9>"$environments/.browser-lock"
    if command -v flock >/dev/null 2>&1; then flock 9; fi
    stamp=$(cat "$here/browser/package-lock.json")
    if [ "$(cat "$directory/ltsh-stamp" 2>/dev/null)" != "$stamp" ]; then
        say "making $directory (300 MB)"
        rm -rf "$directory"
        mkdir -p "$directory/chromium"
        cp "$here/browser/package.json" "$here/browser/package-lock.json" "$directory"
        (cd "$directory" && npm ci --ignore-scripts --no-audit --no-fund --loglevel=error) >&2 </dev/null ||
            fail "npm could not install requirements/browser/package-lock.json; see its messages above"
        (cd "$directory" && TMPDIR=$directory/chromium node --input-type=module --eval '
import { inflate } from "./node_modules/@sparticuz/chromium/build/esm/lambdafs.js";
for (const name of ["chromium.br", "fonts.tar.br", "swiftshader.tar.br", "al2023.tar.br"]) {
    await inflate(`node_modules/@sparticuz/chromium/bin/${name}`);
}') >&2 </dev/null || fail "$directory: the browser could not be unpacked; see the messages above"
        rm -rf "$directory/node_modules/@sparticuz/chromium/bin"
        printf '%s\n' "$stamp" >"$directory/ltsh-stamp.new"
        mv "$directory/ltsh-stamp.new" "$directory/ltsh-stamp"
        say "$directory is ready"
    fi
    exec 9>&-
    printf '%s\n' "$directory"
}

# ---- packages for the tests in a real Blender

# The folder is named after the Python: pip fills it for that one, whatever Python runs pip.
make_blender_packages() {
    local blender=$1 version directory python
    command -v "$blender" >/dev/null 2>&1 || fail "'$blender' is no program, expected the path of Blender: BLENDER=..."
    version=$(limited 120 "$blender" --background --factory-startup --python-expr \
        'import sys; print("ltsh-python %d.%d" % sys.version_info[:2])' 2>/dev/null </dev/null |
        sed -n 's/^ltsh-python //p' || true)
    [ -n "$version" ] || fail "$blender does not tell which Python it has, expected Blender 4.5 or newer"
    directory=$environments/blender-py${version//./}
    if ! cmp -s "$here/blender.txt" "$directory/ltsh-stamp"; then
        python=$(make_environment "$(resolve newest)")
        say "making $directory"
        rm -rf "$directory"
        "$python" -m pip install --quiet --disable-pip-version-check --no-input --no-deps --only-binary :all: \
            --implementation cp --python-version "$version" --target "$directory" --require-hashes \
            -r "$here/blender.txt" >&2 </dev/null ||
            fail "pip could not install requirements/blender.txt for Python $version; see its messages above"
        "$python" "$here/symbolic_wheel.py" "$directory" || fail "$directory: OpenEXR could not be made fit for Blender"
        cp "$here/blender.txt" "$directory/ltsh-stamp"
    fi
    printf '%s\n' "$directory"
}

# ---- lock files

# PIP_* settings of the machine do not reach uv; the --no-emit options keep addresses out of the files.
write_locks() {
    local version python scratch
    python=$(find_python "$(resolve newest)")
    scratch=$(mktemp -d)
    # shellcheck disable=SC2064 # the folder is known now
    trap "rm -rf '$scratch'" EXIT
    "$python" -m venv "$scratch/uv"
    "$scratch/uv/bin/python" -m pip install --quiet --disable-pip-version-check "$uv_requirement"
    for version in $versions; do
        compile "$version" "py${version//./}" "py${version//./}" "$@"
    done
    # The wheels that the extension's zips bring along, for every Python from the oldest one up.
    compile "${versions##* }" runtime wheels --no-deps "$@"
    compile "${versions##* }" blender blender --no-emit-package numpy "$@"
}

# compile PYTHON_VERSION INPUT OUTPUT [OPTION..]; uses `scratch` of the caller.
compile() {
    local version=$1 input=$2 output=$3
    shift 3
    (cd "$here" && "$scratch/uv/bin/uv" pip compile --quiet --no-config --universal --no-python-downloads \
        --python-version "$version" --generate-hashes --no-annotate --no-emit-index-url --no-emit-find-links \
        --custom-compile-command "make lock" "$@" -o "$output.txt" "$input.in")
    say "wrote requirements/$output.txt"
}

main() {
    local version
    case ${1:-} in
    find | python)
        version=$(resolve "${2:-}") || return
        if [ "$1" = find ]; then find_python "$version"; else make_environment "$version"; fi
        ;;
    blender) make_blender_packages "${2:-blender}" ;;
    browser) make_browser ;;
    slurm) install_slurm ;;
    lock) shift && write_locks "$@" ;;
    *) fail "usage: setup.sh find VERSION | python VERSION | blender PROGRAM | browser | slurm | lock [OPTION..]" ;;
    esac
}

main "$@"
