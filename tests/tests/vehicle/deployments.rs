//! Deployments over kills, restarts and failures.

use std::os::unix::fs::symlink;
use std::process::Command;

use gleaner_protocol::supervision::{EventKind, LambdaPhase};
use gleaner_tests::live::signal;
use gleaner_tests::program;
use gleaner_tests::vehicle::{TestVehicle, text};

use super::{PythonLambda, events, files, ticker};

/// Returns the limits of open files of a process: the soft and the hard one.
fn open_files(pid: u32) -> [u64; 2] {
    let limits = std::fs::read_to_string(format!("/proc/{pid}/limits")).expect("it runs");
    let line = limits.lines().find_map(|line| line.strip_prefix("Max open files"));
    let mut numbers = line.expect("a line").split_whitespace();
    [(); 2].map(|()| numbers.next().and_then(|it| it.parse().ok()).expect("a number"))
}

pub fn outlive() {
    let own = std::process::id().to_string();
    let limited = Command::new("prlimit").args(["--pid", &own, "--nofile=256:"]).status();
    assert!(limited.expect("util-linux has `prlimit`").success());
    let mut vehicle = TestVehicle::started();
    let lambdas = [ticker("rust", "first"), ticker("python", "second")];
    for lambda in &lambdas {
        vehicle.deploys(lambda.path());
    }
    let names = ["gleaner-ingress", "gleaner-shim", "gleaner-runtime", "start.py"];
    let processes = |vehicle: &TestVehicle| names.map(|name| vehicle.processes(name));
    let before = processes(&vehicle);
    assert!(before.iter().all(|pids| !pids.is_empty()), "{before:?}");
    for pid in [vehicle.orchestrator(), vehicle.supervisor()] {
        let [soft, hard] = open_files(pid);
        assert!(soft == hard && soft > 256, "{soft} of {hard}");
    }
    let shims = vehicle.processes("gleaner-shim");
    assert!(shims.iter().all(|pid| open_files(*pid)[0] == 1024), "the usual limit");
    vehicle.kill_orchestrator();
    // One that fails meanwhile is started again.
    let runtime = vehicle.processes("start.py")[0];
    signal(runtime, "KILL");
    vehicle.until("the next process", |vehicle| {
        let next = vehicle.processes("start.py");
        (!next.is_empty() && next[0] != runtime).then_some(())
    });
    vehicle.start();
    vehicle.until_running(&["first", "second"]);
    let restarts =
        ["first", "second"].map(|id| vehicle.deployment(id).status.expect("it runs").restarts);
    assert_eq!(restarts, [0, 1]);
    let after = processes(&vehicle);
    assert_eq!(after[0], before[0], "the ingress runs on");
    // SIGHUP replaces the program; its number stays.
    vehicle.reload();
    let started = events(&vehicle, EventKind::Started);
    assert_eq!(started.iter().filter(|text| text.contains("orchestrator")).count(), 3);
    vehicle.until_running(&["first", "second"]);
    assert_eq!(processes(&vehicle), after);
    let decisions = vehicle.records(Some("first"));
    let seqs: Vec<_> = decisions.iter().map(|line| line.seq).collect();
    assert!(seqs.is_sorted_by(|a, b| a < b) && seqs.len() > 3, "{seqs:?}");
    assert!(decisions.iter().any(|line| line.kind == "decision"), "{decisions:?}");
    // Of deployments without a file to send, too.
    let again = vehicle.deploy(lambdas[0].path(), &[]);
    assert!(text(&again).contains("(release 2, 0 files sent)"), "{}", text(&again));
    let supervisor = vehicle.supervisor();
    vehicle.stop();
    let gone = |pid: &u32| !std::path::Path::new(&format!("/proc/{pid}/exe")).exists();
    assert!(after.iter().flatten().chain([&supervisor]).all(gone), "a process is left");
}

pub fn upgraded() {
    let mut vehicle = TestVehicle::new();
    let home = vehicle.path("home");
    std::fs::create_dir(&home).expect("a folder");
    for name in ["compile", "ingress", "runtime", "shim"] {
        let name = format!("gleaner-{name}");
        symlink(program(&name), home.join(name)).expect("a link");
    }
    let supervisor = home.join("gleaner-supervisor");
    std::fs::copy(program("gleaner-supervisor"), &supervisor).expect("a copy");
    vehicle.start();
    let lambda = ticker("rust", "first");
    vehicle.deploys(lambda.path());
    let before = (vehicle.supervisor(), vehicle.processes("gleaner-ingress"));
    // As a package manager does it.
    let new = home.join("new");
    std::fs::copy(&supervisor, &new).and_then(|_| std::fs::rename(&new, &supervisor)).unwrap();
    vehicle.reload();
    vehicle.until_running(&["first"]);
    let after = (vehicle.supervisor(), vehicle.processes("gleaner-ingress"));
    assert_eq!(after, before, "nothing has to start yet");
    signal(vehicle.processes("gleaner-runtime")[0], "KILL");
    vehicle.until("another supervisor", |vehicle| (vehicle.supervisor() != before.0).then_some(()));
    vehicle.until_running(&["first"]);
    let ingress = vehicle.processes("gleaner-ingress");
    assert!(!ingress.is_empty() && ingress != before.1, "{ingress:?}");
    let warnings = events(&vehicle, EventKind::Warning);
    assert!(warnings.iter().any(|it| it.contains("replaced by an upgrade")), "{warnings:?}");
    vehicle.stop();
}

pub fn reaped() {
    let vehicle = TestVehicle::started();
    let supervisor = vehicle.supervisor();
    vehicle.reload();
    vehicle.until("its connection", |vehicle| vehicle.try_status()?.supervisor.map(|_| ()));
    assert_eq!(vehicle.supervisor(), supervisor, "it runs on");
    signal(supervisor, "KILL");
    // Of a zombie, the folder stays.
    let folder = std::path::Path::new("/proc").join(supervisor.to_string());
    vehicle.until("its end", |_| (!folder.exists()).then_some(()));
    vehicle.until("another one", |vehicle| {
        let other = vehicle.supervisor();
        (other != supervisor && vehicle.try_status()?.supervisor.is_some()).then_some(())
    });
}

pub fn stopped() {
    let mut vehicle = TestVehicle::started();
    let lambda = ticker("rust", "ticker");
    vehicle.deploy(lambda.path(), &[]);
    vehicle.succeeds(&["stop", "ticker"]);
    assert!(vehicle.processes("gleaner-shim").is_empty());
    vehicle.stop();
    vehicle.start();
    // A state that was sent is applied before the next status.
    vehicle.until("the supervisor", |vehicle| vehicle.status().supervisor);
    let deployment = vehicle.deployment("ticker");
    assert!(!deployment.is_wanted && deployment.status.is_none(), "{deployment:?}");
    let started = vehicle.succeeds(&["start", "ticker"]);
    assert!(started.contains("running 0.1.0 after"), "{started}");
    let unknown = text(&vehicle.gleaner(&["stop", "tacker"]));
    assert!(unknown.contains("there is no deployment `tacker`"), "{unknown}");
    assert!(unknown.contains("the deployments are `ticker`"), "{unknown}");
}

pub fn removed() {
    let mut vehicle = TestVehicle::started();
    let [lambda, other] = ["ticker", "other"].map(|name| ticker("rust", name));
    for (lambda, args) in [(&lambda, &["--release", "7"][..]), (&other, &[])] {
        let deployed = vehicle.deploy(lambda.path(), args);
        assert!(deployed.status.success(), "{}", text(&deployed));
    }
    let removed = vehicle.succeeds(&["remove", "ticker"]);
    assert_eq!(removed, "removed `ticker`\n");
    assert_eq!(vehicle.processes("gleaner-shim").len(), 1);
    let ids = |vehicle: &TestVehicle| -> Vec<String> {
        vehicle.status().deployments.into_iter().map(|it| it.id).collect()
    };
    assert_eq!(ids(&vehicle), ["other"]);
    vehicle.until("the end of its files", |vehicle| {
        let of_other = [vehicle.path("state/records/other")];
        let is_gone = files(&vehicle.path("state/records")) == of_other;
        (is_gone && files(&vehicle.path("state/revisions")).len() == 1).then_some(())
    });
    assert!(!vehicle.records(Some("ticker")).is_empty(), "its records can be read");
    let again = text(&vehicle.gleaner(&["remove", "ticker"]));
    assert!(again.contains("there is no deployment `ticker`"), "{again}");
    assert!(again.contains("the deployments are `other`"), "{again}");
    vehicle.stop();
    vehicle.start();
    vehicle.until_running(&["other"]);
    assert_eq!(ids(&vehicle), ["other"]);
    let old = text(&vehicle.deploy(lambda.path(), &["--release", "6"]));
    assert!(old.contains("exit status: 3") && old.contains('7'), "{old}");
    // What a vehicle reports decides nothing of a signature: the deployer does.
    let unnamed = text(&vehicle.deploy(lambda.path(), &[]));
    assert!(
        unnamed.contains("exit status: 3") && unnamed.contains("reports release 7"),
        "{unnamed}"
    );
    let next = text(&vehicle.deploy(lambda.path(), &["--release", "8"]));
    assert!(next.contains("(release 8, ") && next.contains("running"), "{next}");
}

/// A lambda whose process ends in its third wake.
const FAILING: &str = "def on_tick(self, ctx):\n\
                       \u{20}   self.wakes += 1\n\
                       \u{20}   if self.wakes == 3:\n\
                       \u{20}       import os\n\
                       \u{20}       os.abort()";
const HARMLESS: &str = "def on_tick(self, ctx):\n    pass";

pub fn fallback() {
    let mut vehicle = TestVehicle::started();
    let lambda = PythonLambda::new("guard", HARMLESS);
    let other = ticker("rust", "other");
    for path in [lambda.path(), other.path()] {
        vehicle.deploys(path);
    }
    lambda.write("guard", "0.2.0", FAILING);
    vehicle.deploy(lambda.path(), &[]);
    vehicle
        .until("the fallback", |vehicle| vehicle.deployment("guard").runs_fallback.then_some(()));
    vehicle.until_running(&["guard", "other"]);
    let failed = vehicle.deployment("guard");
    let reason = failed.failed.as_deref().unwrap_or_default();
    assert!(reason.contains("it failed 5 times within 10 minutes"), "{failed:?}");
    let status = failed.status.expect("it runs");
    assert_eq!(Some(status.revision), failed.fallback.map(|fallback| fallback.digest));
    assert_eq!(vehicle.deployment("other").status.expect("it runs").restarts, 0);
    // The failed revision is not tried again.
    vehicle.stop();
    vehicle.start();
    vehicle.until_running(&["guard", "other"]);
    assert!(vehicle.deployment("guard").runs_fallback);
    assert_eq!(events(&vehicle, EventKind::RolledBack).len(), 1);
    // Revisions that neither run nor ran before are removed.
    for version in ["0.3.0", "0.4.0", "0.5.0", "0.6.0"] {
        lambda.write("guard", version, HARMLESS);
        let deployed = vehicle.deploy(lambda.path(), &["--fallback", "none"]);
        assert!(text(&deployed).contains(&format!("running {version}")), "{}", text(&deployed));
    }
    let revisions = files(&vehicle.path("state/revisions"));
    assert_eq!(revisions.len(), 4, "one of `other`, the newest, and two before: {revisions:?}");
    assert!(files(&vehicle.path("state/objects")).is_empty());
    // A fallback that is taken while a deployment waits is a failure of it.
    lambda.write("guard", "0.7.0", "def __init__(self, ctx):\n    raise ValueError('no')");
    let said = text(&vehicle.deploy(lambda.path(), &[]));
    assert!(said.contains("exit status: 6"), "{said}");
    assert!(said.contains("deployment `guard` runs its fallback 0.6.0"), "{said}");
    assert!(said.contains("0.7.0 failed: it failed 3 times in a row"), "{said}");
}

pub fn quarantined() {
    let vehicle = TestVehicle::started();
    let other = ticker("rust", "other");
    vehicle.deploy(other.path(), &[]);
    let failing =
        PythonLambda::new("broken", "def __init__(self, ctx):\n    raise ValueError('no')");
    let deployed = vehicle.deploy(failing.path(), &[]);
    let said = text(&deployed);
    assert_eq!(deployed.status.code(), Some(6), "{said}");
    assert!(said.contains("deployment `broken` does not run"), "{said}");
    assert!(said.contains("it failed 3 times in a row before it was ready"), "{said}");
    // One that kills itself looks as if another program had killed it, but for the time.
    let ending = |name, how| {
        let code = format!("def __init__(self, ctx):\n    import os\n    {how}\n{HARMLESS}");
        text(&vehicle.deploy(PythonLambda::new(name, &code).path(), &[]))
    };
    let said = ending("killer", "os.kill(os.getpid(), 9)");
    assert!(said.contains("it failed 3 times in a row before it was ready"), "{said}");
    assert!(said.contains("was ended by signal 9 (SIGKILL)"), "{said}");
    // An exit code that the lambda chose is not one of the runtime.
    let said = ending("quitter", "os._exit(2)");
    assert!(said.contains("it failed 3 times in a row before it was ready"), "{said}");
    assert!(said.contains("code ended its process with exit code 2 in its constructor"), "{said}");
    let status = vehicle.deployment("broken").status.expect("it is known");
    assert_eq!((status.phase, status.restarts), (LambdaPhase::Quarantined, 2));
    // Its log has the cause, also of the first process.
    let log = vehicle.records(Some("broken"));
    let starts = log.iter().filter(|line| line.kind == "started").count();
    assert_eq!(starts, 3, "{log:?}");
    assert_eq!(vehicle.deployment("other").status.expect("it runs").restarts, 0);
    assert_eq!(events(&vehicle, EventKind::Quarantined).len(), 3);
}

pub fn killed_by_itself() {
    let vehicle = TestVehicle::started();
    let code = "def __init__(self, ctx):\n\
                \u{20}   import os, threading\n\
                \u{20}   threading.Timer(0.25, os.kill, (os.getpid(), 9)).start()\n\
                def on_tick(self, ctx):\n    pass";
    let lambda = PythonLambda::new("killer", code);
    vehicle.deploy(lambda.path(), &[]);
    let status = vehicle.until("the quarantine", |vehicle| {
        let status = vehicle.deployment("killer").status;
        status.filter(|status| status.phase == LambdaPhase::Quarantined)
    });
    let reason = status.last_end.unwrap_or_default();
    assert!(reason.contains("killed 15 times in a row"), "{reason}");
    assert!(reason.contains("signal 9 (SIGKILL), by another program or by the lambda"), "{reason}");
    // An end in a wake counts as a fault of the lambda instead, and it is started again.
    assert!((14..=17).contains(&status.restarts), "{}", status.restarts);
}

pub fn at_once() {
    let vehicle = TestVehicle::started();
    // The ids are also names of streams of the daemon itself.
    let names = ["first", "second", "events", "orchestrator"];
    let lambdas = names.map(|name| PythonLambda::new(name, HARMLESS));
    let vehicle = &vehicle;
    std::thread::scope(|scope| {
        let deploy = |lambda| scope.spawn(move || vehicle.deploy(PythonLambda::path(lambda), &[]));
        let all: Vec<_> = lambdas.iter().chain(&lambdas[..2]).map(deploy).collect();
        let outputs = all.into_iter().map(|it| it.join().expect("it deploys"));
        let failed: Vec<_> =
            outputs.filter(|it| !it.status.success()).map(|it| text(&it)).collect();
        // Of two of one lambda at once, one may have the release that the other one has.
        let is_same = |said: &String| said.contains("was accepted before with release 1 as");
        assert!(failed.len() <= 2 && failed.iter().all(is_same), "{failed:?}");
    });
    vehicle.until_running(&names);
    assert!(events(vehicle, EventKind::Warning).is_empty(), "{}", vehicle.log());
}
