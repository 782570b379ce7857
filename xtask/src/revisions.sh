# Measures two revisions in turns by a benchmark: BASE HEAD NAME [--rounds N] [options of NAME].
# `cargo xtask bench compare` runs it in the checkout. Each revision has a checkout of its own below
# `revisions` of the target folder, with its own build. It is kept, so that only the first
# measurement of a revision takes the time of a build.
set -euo pipefail
# Set by hooks of git, these would let it work on another checkout.
unset GIT_DIR GIT_WORK_TREE GIT_INDEX_FILE GIT_COMMON_DIR

fail() { printf 'error: %s\n  help:  %s\n' "$2" "$3" >&2; exit "$1"; }

target=$CARGO_TARGET_DIR runs=$CARGO_TARGET_DIR/bench/compare
revisions=("$1" "$2") name=$3
shift 3
# Rows with fewer than five values get no verdict.
rounds=5
if [ "${1:-}" = --rounds ]; then
  rounds=${2:-}
  [[ $rounds =~ ^[1-9][0-9]{0,2}$|^1000$ ]] ||
    fail 2 "\`--rounds\` takes a number from 1 to 1000" "the default is 5"
  shift 2
fi
benchmarks="rtt, scale, isolation, cold-start, replay, record, drives, kernels, inference, fleet"
[[ ", $benchmarks, " == *", $name, "* ]] ||
  fail 2 "\`$name\` cannot be measured in two revisions" "name one of these: $benchmarks"
mkdir -p "$target/revisions"
exec {lock}>"$target/revisions/lock"
flock --nonblock "$lock" || fail 2 "another comparison of revisions runs in this checkout" \
  "wait for its end: they would disturb each other"
for side in 0 1; do
  revision=${revisions[side]}
  commits[side]=$(git rev-parse --verify --quiet --end-of-options "$revision^{commit}") ||
    fail 2 "\`$revision\` is no revision of this repository" "name a commit, a branch or a tag"
  folders[side]=$target/revisions/${commits[side]::12}
done
[ "${commits[0]}" != "${commits[1]}" ] ||
  fail 2 "\`${revisions[0]}\` and \`${revisions[1]}\` are one revision" \
    "commit the change that is to be measured"
[ -z "$(git status --porcelain --untracked-files=no)" ] ||
  echo "changes that are not committed are not measured"

# Runs cargo in the checkout of a side.
in_revision() (cd "${folders[$1]}" && CARGO_TARGET_DIR=$PWD/target "$CARGO" xtask "${@:2}")

# Runs the benchmark of the side $1 with its results in $2, and further options.
measure() {
  # A goal that is not met is no error here.
  in_revision "$1" bench "$name" "${@:3}" --out "$2" || true
  [ -f "$2/results.json" ] || fail 1 "\`${revisions[$1]}\` has no results of $name" \
    "see its messages above; revisions without \`bench NAME --out DIR\` cannot be compared"
}

rm -rf "$runs"
sides=(base head)
for side in 0 1; do
  folder=${folders[side]} commit=${commits[side]}
  echo "${revisions[side]}, built in $folder"
  # Otherwise there is none yet, or git was interrupted in it.
  if ! [ -f "$folder/.git" ] || ! git -C "$folder" checkout --quiet --force --detach "$commit"; then
    rm -rf "$folder"
    git worktree add --force --detach "$folder" "$commit" ||
      fail 1 "git made no checkout of \`${revisions[side]}\`" "see its message above"
  fi
  # The player is not built with the other programs.
  case $name in rtt | scale | isolation) in_revision "$side" player ;; esac
  # A short run builds all that the benchmark needs, and shows that the revision can be measured.
  rm -rf "$folder/target/bench/trial"
  measure "$side" "$folder/target/bench/trial" --quick
done
for ((round = 1; round <= rounds; round++)); do
  # Each begins in every second round.
  for side in $(((round + 1) % 2)) $((round % 2)); do
    echo "${revisions[side]}, run $round of $rounds"
    measure "$side" "$runs/${sides[side]}/$(printf %03d "$round")" "$@"
  done
done
echo "A is ${revisions[0]} (${commits[0]::12}), B is ${revisions[1]} (${commits[1]::12})"
