# Replays lambdas by the programs of this machine and by those for aarch64, in the folders $1 and $2,
# and compares what they decide, bit for bit: decisions with their fuel, log lines and thumbnails. $3
# is the emulator, and $4 the folder above `lib` of the C library for aarch64.
# `cargo xtask aarch64` runs it in the checkout. Its exit code is 4 if a replay is not as expected.
set -euo pipefail

here=$1 drive=examples/data/highway_drive.mcap out=out/aarch64
cases=0 unexpected=0
cache=$(mktemp -d)
trap 'rm -rf "$cache"' EXIT

# The emulated programs start each other by these scripts, but the shim of this machine.
there=$PWD/$out/emulated
rm -rf "$out"
mkdir -p "$there"
for name in gleaner gleaner-compile gleaner-inference gleaner-runtime; do
  printf '#!/bin/sh\nexec %q -L %q %q "$@"\n' "$3" "$4" "$2/$name" >"$there/$name"
done
printf '#!/bin/sh\nexec %q "$@"\n' "$here/gleaner-shim" >"$there/gleaner-shim"
chmod +x "$there"/*

# Without the variable, the emulated programs would start those beside the emulator.
program() { GLEANER_HOME=$1 "$1/$2" "${@:3}" </dev/null; }
fail() { printf 'error: %s\n' "$1" >&2; exit "${2:-4}"; }

# Replays the lambda $3 by the programs $1 into the folder $2, with the further arguments. It may
# fault, as some have to.
replay() {
  mkdir -p "$2"
  program "$1" gleaner replay "$3" "$drive" --all --json --out "$2" --journal "$2/wakes.journal" \
    "${@:4}" >"$2/summary" || [ $? = 6 ] || fail "no result of \`$3\` by the programs in $1" 1
  local wakes
  wakes=$(sed -E 's/.*"wakes":([0-9]+).*/\1/; q' "$2/summary")
  [ -f "$2/log.jsonl" ] || fail "\`$2\` has no log" 1
  [ "$(wc -l <"$2/decisions.jsonl")" = "$wakes" ] || fail "\`$2\` has not $wakes decisions" 1
}

# Prints what has to be equal of a replay: all but run times.
results() (
  cd "$1"
  sed -E 's/"(run|model)_ns":[0-9]+/"\1_ns":0/g' decisions.jsonl
  cat log.jsonl
  [ ! -d clips ] || find clips -name '*.jpg' -exec sha256sum {} + | sort
)

# Replays the lambda $2 on both processors, with the further arguments. $1 is empty, or the reason
# why the results must differ, which also proves that differences are found.
compare() {
  local why=$1 lambda=$2 folder began=$SECONDS verdict
  cases=$((cases + 1))
  folder=$out/$cases
  echo "${*:2}"
  replay "$here" "$folder/here" "${@:2}"
  replay "$there" "$folder/aarch64" "${@:2}"
  awk -F '"fuel":' '{ fuel += $2 } END { printf "  %d wakes, %.0f fuel", NR, fuel }' \
    "$folder/here/decisions.jsonl"
  echo ", $(grep -oE '"(triggers|faults)":[0-9]+' "$folder/here/summary" | xargs)," \
    "$((SECONDS - began)) s"
  if diff <(results "$folder/here") <(results "$folder/aarch64") >"$folder/difference"; then
    verdict="EQUAL, but must differ: $why"
    if [ -z "$why" ]; then
      verdict=$(program "$there" gleaner replay "$lambda" "$drive" --json \
        --verify "$folder/here/wakes.journal" | grep -oE '"wakes":[0-9]+') ||
        fail "the journal of $folder is not repeated there"
      verdict="equal, and the journal of here repeated there: $verdict"
    else
      unexpected=$((unexpected + 1))
    fi
  elif [ -n "$why" ]; then
    verdict="differs as expected, $why: $(sed 3q "$folder/difference" | cut -c 1-400)"
  else
    verdict="DIFFERS: $(sed 3q "$folder/difference" | cut -c 1-400)"
    unexpected=$((unexpected + 1))
  fi
  echo "  $verdict"
}

# Code compiled here, under the name of that of the other processor, is compiled again.
component=examples/hello/rust/build/hello.wasm
foreign=$(program "$here" gleaner-compile "$component" --cache "$cache/here")
own=$(program "$there" gleaner-compile "$component" --cache "$cache/gleaner")
[ "${foreign##*/}" != "${own##*/}" ] || fail "code of both processors has one name in the cache"
cp "$foreign" "$own"
XDG_CACHE_HOME=$cache program "$there" gleaner replay examples/hello/rust "$drive" \
  --out "$cache/out" 2>"$cache/warning" >"$cache/output" || fail "$(cat "$cache/warning")"
grep "native code in the cache is damaged" "$cache/warning" ||
  fail "code of this processor was not replaced there: $(cat "$cache/warning")"

# Triggers, all pixels of all pictures, floating point, and every kind of fault that depends on the
# processor.
mkdir -p "$out/deterministic/build"
compare "" examples/hello/rust --set brake_mps2=-1.4
compare "" examples/brake-dark/rust --set brake_mps2=-1.4 --set dark_luma=50
# Every picture is bright enough, and the car always brakes.
compare "" examples/brake-dark/rust --set brake_mps2=100 --set dark_luma=255
compare "" tests/lambdas/probe/rust --set every=1
compare "" tests/lambdas/kernels/rust
# A model; emulated, it takes seconds for each frame.
compare "" examples/yolo-detector/rust --to 1 --set "classes=person, car, truck, bus" \
  --set min_score=0.05
misbehave=tests/lambdas/misbehave/rust
for behaviour in recurse endless panic memory host_calls; do
  compare "" "$misbehave" --set "behaviour=$behaviour"
done
# A limit of the vehicle that is smaller than that of the manifest.
printf '[limits]\nstack = "16 KiB"\n' >"$out/vehicle.toml"
compare "" "$misbehave" --set behaviour=recurse --vehicle "$out/vehicle.toml"
compare "the NaN of an arithmetic operation has a sign here and none there" \
  "$misbehave" --set behaviour=nan_bits
# The manifest of the build is written last, since a build must not be older than its source.
cp -r "$misbehave/build/." "$out/deterministic/build"
sed 's/^\[lambda\]$/&\ndeterministic = true/' "$misbehave/build/lambda.toml" \
  >"$out/deterministic/lambda.toml"
cp "$out/deterministic/lambda.toml" "$out/deterministic/build"
compare "" "$out/deterministic" --set behaviour=nan_bits

echo "$((cases - unexpected)) of $cases replays as expected"
echo "files: $out/"
[ "$unexpected" = 0 ] || exit 4
