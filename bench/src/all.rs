//! All benchmarks of a vehicle, one after the other, each in a process of its own: one that fails
//! does not end the others. Their results, and facts about the machine, become one file.

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};
use std::time::Instant;

use gleaner_base::{Exit, Failure};
use gleaner_bench::{BenchEnd, OUTPUT, SequenceEntry};
use gleaner_tests::{find_program, root};

use crate::live::until_end;

/// The benchmarks, with the time that each takes. Short ones come first, so that there are results
/// early.
const BENCHMARKS: [(&str, &str); 9] = [
    ("cold-start", "a minute"),
    ("kernels", "a minute"),
    ("replay", "two minutes"),
    ("record", "three minutes"),
    ("drives", "two minutes"),
    ("inference", "5 minutes"),
    ("scale", "24 minutes"),
    ("isolation", "28 minutes"),
    ("rtt", "two to three hours"),
];

/// Facts about the machine, by shell commands that change nothing. `gleaner` is that of this bench.
const FACTS: &str = "uname -srvm
cat /etc/os-release
cat /etc/nv_tegra_release
tr -d '\\0' </proc/device-tree/model
cat /proc/cmdline
lscpu
free -m
nvpmodel -q
jetson_clocks --show
cat /proc/loadavg
cat /proc/sys/net/core/rmem_max
stat -fc %T /sys/fs/cgroup
grep -s . /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor
grep -s . /sys/devices/system/cpu/cpu*/cpufreq/scaling_cur_freq
grep -s . /sys/devices/system/cpu/cpu0/cpuidle/state*/name
grep -s . /sys/devices/system/cpu/cpu*/cpuidle/state*/disable
grep -s . /sys/devices/virtual/thermal/thermal_zone*/type
grep -s . /sys/devices/virtual/thermal/thermal_zone*/temp
grep -s . /sys/class/hwmon/hwmon*/name
grep -s . /sys/class/hwmon/hwmon*/in*_*
grep -s . /sys/class/hwmon/hwmon*/curr*_input
python3 --version
gleaner doctor";

/// Runs all benchmarks but those in `skip`, and packs their results into a file in `out`.
pub fn run(quick: bool, skip: &[String], out: Option<&Path>) -> Result<ExitCode, Failure> {
    if let Some(unknown) = skip.iter().find(|name| !BENCHMARKS.iter().any(|(it, _)| it == name)) {
        let names = BENCHMARKS.map(|(name, _)| name).join(", ");
        return Err(Failure::new(
            Exit::Usage,
            format!("there is no benchmark `{unknown}` to skip"),
        )
        .with_help(format!("name one of: {names}")));
    }
    let name = format!("gleaner-bench-{}-{}", host(), answer("date -u +%Y%m%dT%H%M%SZ"));
    let out = out.map_or_else(|| root().join("target/bench"), Path::to_owned);
    let folder = out.join(&name);
    create(&folder)?;
    println!("results: {}", folder.display());
    write(&folder.join("machine-before.txt"), &facts())?;
    let mut entries = Vec::new();
    let mut is_ended = false;
    for (index, (bench, duration)) in BENCHMARKS.iter().enumerate() {
        let (began, mut end) = (Instant::now(), BenchEnd::Skipped("as asked by --skip".to_owned()));
        if is_ended {
            end = BenchEnd::Skipped("the run was ended before".to_owned());
        } else if !skip.iter().any(|name| name == bench) {
            let results = folder.join(bench);
            println!("[{}/{}] {bench}, about {duration}", index + 1, BENCHMARKS.len());
            (end, is_ended) = measure(bench, quick, &results)?;
        }
        println!("{bench}: {end}");
        entries.push(SequenceEntry {
            bench: (*bench).to_owned(),
            seconds: began.elapsed().as_secs_f64(),
            end,
        });
        // Written each time, so that there is one whatever happens.
        write(&folder.join("summary.md"), &SequenceEntry::to_markdown(&entries))?;
    }
    write(&folder.join("machine-after.txt"), &facts())?;
    let archive = pack(&out, &name)?;
    let size = archive.metadata().map_or(0, |data| data.len().div_ceil(1024));
    println!("all results in one file: {} ({size} KiB)", archive.display());
    println!(
        "to send it: look through machine-before.txt and the logs for what you keep to yourself, \
         then attach the file to a mail or an issue; docs/orin.md has the details"
    );
    Ok(ExitCode::from(u8::from(!entries.iter().all(|entry| entry.end.is_good()))))
}

/// Runs a benchmark to its end, and returns also whether a signal has asked to end everything.
fn measure(bench: &str, quick: bool, folder: &Path) -> Result<(BenchEnd, bool), Failure> {
    create(folder)?;
    let path = folder.join(OUTPUT);
    let output = File::create(&path).map_err(|error| cannot("create", &path, &error))?;
    let errors = output.try_clone().map_err(|error| cannot("open", &path, &error))?;
    println!("  output: {}", path.display());
    let failed = |error| {
        Failure::caused_by(Exit::Internal, format!("cannot run the benchmark `{bench}`"), &error)
    };
    let mut command = Command::new(std::env::current_exe().map_err(failed)?);
    command.arg(bench).arg("--out").arg(folder).args(quick.then_some("--quick"));
    command.stdin(Stdio::null()).stdout(output).stderr(errors);
    let (status, is_ended) = until_end(&mut command).map_err(failed)?;
    let is_skipped = status.code() == Some(crate::SKIPPED.into());
    Ok((BenchEnd::read(folder, is_skipped, &status.to_string()), is_ended))
}

/// Returns the output of [`FACTS`]; what is missing here is named, too.
fn facts() -> String {
    let mut text = String::new();
    for command in FACTS.lines() {
        text += &format!("$ {command}\n{}\n\n", answer(command));
    }
    text
}

/// Returns the output of a shell command, its errors included.
fn answer(command: &str) -> String {
    let mut shell = Command::new("sh");
    shell.args(["-c", &format!("exec 2>&1; {command}")]).stdin(Stdio::null());
    if let Some(programs) = find_program("gleaner").as_deref().and_then(Path::parent) {
        let path = std::env::var_os("PATH").unwrap_or_default();
        let folders = [programs.to_owned()].into_iter().chain(std::env::split_paths(&path));
        if let Ok(path) = std::env::join_paths(folders) {
            shell.env("PATH", path);
        }
    }
    match shell.output() {
        Ok(output) => String::from_utf8_lossy(&output.stdout).trim_end().to_owned(),
        Err(error) => format!("cannot start a shell: {error}"),
    }
}

/// Returns the name of the machine, as part of a file name.
fn host() -> String {
    let name = fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let is_plain = |character: &char| character.is_ascii_alphanumeric() || *character == '-';
    name.chars().filter(is_plain).take(63).collect()
}

/// Packs the folder `name` in `out`, and returns the path of the file.
fn pack(out: &Path, name: &str) -> Result<PathBuf, Failure> {
    let archive = out.join(format!("{name}.tar.gz"));
    let mut tar = Command::new("tar");
    tar.arg("--create").arg("--gzip").arg("--file").arg(&archive);
    tar.args(["--owner=0", "--group=0", "--numeric-owner"]).arg("--directory").arg(out).arg(name);
    let packed = tar.stdin(Stdio::null()).status();
    if packed.as_ref().is_ok_and(std::process::ExitStatus::success) {
        return Ok(archive);
    }
    let message = format!("cannot pack the results into `{}`", archive.display());
    let failure = match packed {
        Ok(status) => {
            let mut failure = Failure::new(Exit::Internal, message);
            failure.causes = vec![format!("`tar` ended with {status}")];
            failure
        }
        Err(error) => Failure::caused_by(Exit::Internal, message, &error),
    };
    Err(failure.with_help(format!("pack the folder yourself: {}", out.join(name).display())))
}

fn create(folder: &Path) -> Result<(), Failure> {
    fs::create_dir_all(folder).map_err(|error| cannot("create", folder, &error))
}

fn write(path: &Path, text: &str) -> Result<(), Failure> {
    let written = File::create(path).and_then(|mut file| file.write_all(text.as_bytes()));
    written.map_err(|error| cannot("write", path, &error))
}

fn cannot(action: &str, path: &Path, error: &std::io::Error) -> Failure {
    Failure::caused_by(Exit::Internal, format!("cannot {action} `{}`", path.display()), error)
        .with_help("choose a folder that can be written: --out DIR")
}
