# Tests the package $1 in roots of their own below $2: installs, runs, upgrades, removes and purges it
# there, without a network. `test/in-root` of the folder $3 runs without systemd, and `test/booted`, if
# there is one, in a container of systemd-nspawn. With $4, lambdas that are built are tested, too.
# `cargo xtask deb --test` runs it in the checkout. Nothing of this machine is changed.
set -euo pipefail

package=$1 work=$2 tests=$3/test lambdas=${4:-}
fail() { printf 'error: %s\n  help:  %s\n' "$2" "$3" >&2; exit "$1"; }

[ "$(id -u)" = 0 ] || fail 2 "only root can install a package into a root" \
  "run \`cargo xtask deb\`, then \`sudo cargo xtask deb --test\`"
for tool in debootstrap unshare; do
  command -v "$tool" >/dev/null || fail 5 "\`$tool\` is missing" \
    "on Debian and Ubuntu, as root: apt-get install debootstrap util-linux"
done
suite=${GLEANER_SUITE:-bookworm}
base=$work/$suite root=$work/root
if ! [ -e "$base/etc/debian_version" ]; then
  echo "debootstrap $suite (minutes)"
  rm -rf "$base" "$base.new"
  # Beyond what is required: for Python lambdas, and the units.
  packages=dbus,init-system-helpers,python3,python3-numpy,python3-venv,systemd
  debootstrap --variant=minbase --include="$packages" "$suite" "$base.new" ||
    fail 5 "debootstrap made no root of $suite" "check the network; its messages are above"
  mv "$base.new" "$base"
fi

# Copies the root, and puts the package, lambdas and scripts into it; sets the arguments of these.
prepare() {
  rm -rf "$root"
  cp -a -- "$base" "$root"
  mkdir "$root/test"
  cp -a -- "$package" "$root/test/gleaner.deb"
  cp -a -- "$tests/." "$root/test"
  arguments=(/test/gleaner.deb)
  [ -n "$lambdas" ] || return 0
  # One with a model, which is only checked there.
  if [ -e examples/yolo-detector/rust/build ]; then
    cp -a -- examples/yolo-detector/rust "$root/test/model"
  fi
  # Both kinds, with different names.
  for lambda in examples/hello/rust examples/brake-dark/python; do
    if [ -e "$lambda/build" ]; then
      cp -a -- "$lambda" "$root/test/${lambda//\//-}"
      arguments+=("${lambda//\//-}")
    else
      echo "skipped: $lambda is not built; \`cargo xtask build\` builds it"
    fi
  done
}

prepare
echo "$root, without systemd"
# `ip` of this machine, as the root need not have it.
unshare --mount --pid --net --ipc --uts --fork --kill-child sh -c '
  if command -v ip >/dev/null; then
    ip link set lo up multicast on
    ip route add 224.0.0.0/4 dev lo
  fi
  mount -t proc proc "$1/proc" && root=$1 && shift && exec chroot "$root" "$@"
' sh "$root" /usr/bin/env -i /test/in-root "${arguments[@]}" ||
  fail 4 "the test without systemd failed" "the log of the service is $root/test/log"

[ -e "$tests/booted" ] || exit 0
if ! systemd-nspawn --version >/dev/null 2>&1; then
  echo "skipped: no test with systemd, as systemd-nspawn (systemd-container) is missing"
  exit 0
fi
prepare
echo "$root, with systemd"
units=$root/etc/systemd/system
mkdir -p "$units/default.target.wants"
ln -s ../test.service "$units/default.target.wants/test.service"
cat >"$units/test.service" <<EOF
[Unit]
After=multi-user.target
SuccessAction=poweroff-force
FailureAction=poweroff-force
[Service]
Type=oneshot
ExecStart=/bin/sh -c 'exec /test/booted ${arguments[*]} >/test/log 2>&1'
TimeoutStartSec=10min
EOF
# System calls that a container needs beyond those of systemd-nspawn.
calls="landlock_add_rule landlock_create_ruleset landlock_restrict_self pidfd_getfd"
# Its exit code is that of the container, not that of the test.
systemd-nspawn --quiet --boot --private-network --register=no --keep-unit --console=pipe \
  --system-call-filter="$calls" --directory "$root" </dev/null >"$work/console" 2>&1 || true
cat "$root/test/log" || true
[ "$(tail -n 1 "$root/test/log" 2>/dev/null)" = "-- passed" ] ||
  fail 4 "the test of the service failed" "its output is above"
