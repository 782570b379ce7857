//! `cargo xtask peers`: builds test programs on other DDS implementations, for the suite `dds`.
//! Programs whose packages are installed are built into `peers/` of the target folder; for the
//! others the missing packages are named.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure};

use crate::checkout::Checkout;
use crate::steps::{self, Steps, run, succeeds};
use crate::venv;

/// Debian and Ubuntu packages of Cyclone DDS.
const CYCLONE: [&str; 2] = ["cyclonedds-dev", "cyclonedds-tools"];
const FAST: [&str; 4] = ["libfastrtps-dev", "libfastcdr-dev", "fastddsgen", "default-jre-headless"];
/// Packages for the private networks of tests.
const NETWORK: [&str; 2] = ["iproute2", "nftables"];

/// A Gid has 24 bytes up to ROS 2 Humble and 16 since Iron.
const GID_SIZES: [u32; 2] = [24, 16];

const COMPILER: &str = "see the first error above; a C and a C++ compiler are needed";

/// Builds the peers; `--install` fetches what is missing first.
pub(crate) fn build(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let install = steps::has_flag("peers", "--install", arguments)?;
    let peers = Peers { checkout, folder: checkout.target().join("peers") };
    let mut steps = Steps::of(4);
    steps.begin("packages");
    // Those that can be built are built, whatever is missing for the others.
    let required = steps::require_packages(checkout, "peers", install, || peers.missing());
    steps.begin("Cyclone DDS in C");
    if peers.has_cyclone() {
        peers.cyclone()?;
    } else {
        println!("skipped: {} are missing", CYCLONE.join(" and "));
    }
    steps.begin("Fast DDS in C++");
    if peers.has_fast() {
        peers.fast()?;
    } else {
        println!("skipped: {} are missing", FAST.join(", "));
    }
    steps.begin("Cyclone DDS in Python");
    peers.python()?;
    println!("peers are in {}", peers.folder.display());
    required.map(|()| Exit::Ok)
}

struct Peers<'c> {
    checkout: &'c Checkout,
    folder: PathBuf,
}

impl Peers<'_> {
    fn has(&self, program: &str, argument: &str) -> bool {
        succeeds(self.checkout.command(program).arg(argument))
    }

    fn has_header(&self, compiler: &str, language: &str, header: &str) -> bool {
        let mut compile = self.checkout.command(compiler);
        succeeds(compile.args(["-fsyntax-only", "-x", language, "-include", header, "/dev/null"]))
    }

    fn has_cyclone(&self) -> bool {
        self.has("idlc", "-h") && self.has_header("cc", "c", "dds/dds.h")
    }

    fn has_fast(&self) -> bool {
        self.has("fastddsgen", "-version")
            && self.has_header("c++", "c++", "fastdds/dds/domain/DomainParticipant.hpp")
            && self.has_header("c++", "c++", "fastcdr/Cdr.h")
    }

    fn missing(&self) -> Vec<&'static str> {
        let network = self.has("ip", "-V") && self.has("nft", "-v");
        let groups = [
            (self.has_cyclone(), &CYCLONE[..]),
            (self.has_fast(), &FAST[..]),
            (network, &NETWORK[..]),
        ];
        groups
            .into_iter()
            .filter(|(there, _)| !there)
            .flat_map(|(_, packages)| packages)
            .copied()
            .collect()
    }

    /// A folder below `peers/` for generated files.
    fn generated(&self, name: &str) -> Result<PathBuf, Failure> {
        let folder = self.folder.join(name);
        steps::make_folder(&folder).map(|()| folder)
    }

    fn source(&self, name: &str) -> PathBuf {
        self.checkout.path("tests/peers").join(name)
    }

    fn cyclone(&self) -> Result<(), Failure> {
        let messages = self.generated("cyclone")?;
        self.idlc(&["-o".as_ref(), messages.as_ref(), self.source("messages.idl").as_ref()])?;
        let sources = [
            self.source("cyclone/peer.c"),
            self.source("cyclone/content.c"),
            messages.join("messages.c"),
        ];
        self.compile_c(&messages, &sources, "cyclone-peer")?;
        for size in GID_SIZES {
            let graph = self.generated(&format!("graph-{size}"))?;
            let define = format!("-DGID_SIZE={size}");
            self.idlc(&[
                define.as_ref(),
                "-o".as_ref(),
                graph.as_ref(),
                self.source("graph.idl").as_ref(),
            ])?;
            let sources = [self.source("cyclone/graph.c"), graph.join("graph.c")];
            self.compile_c(&graph, &sources, &format!("cyclone-graph-{size}"))?;
        }
        Ok(())
    }

    fn idlc(&self, arguments: &[&Path]) -> Result<(), Failure> {
        let mut idlc = self.checkout.command("idlc");
        run(idlc.args(arguments), "see the error above")
    }

    fn compile_c(&self, generated: &Path, sources: &[PathBuf], name: &str) -> Result<(), Failure> {
        let mut cc = self.checkout.command("cc");
        cc.args(["-O2", "-Wall", "-Wextra", "-I"]).arg(generated).arg("-I").arg(self.source(""));
        run(cc.args(sources).arg("-lddsc").arg("-o").arg(self.folder.join(name)), COMPILER)
    }

    fn fast(&self) -> Result<(), Failure> {
        let generated = self.generated("fast")?;
        let mut generate = self.checkout.command("fastddsgen");
        generate.args(["-replace", "-d"]).arg(&generated).arg(self.source("messages.idl"));
        run(&mut generate, "see the error above")?;
        let mut cc = self.checkout.command("c++");
        cc.args(["-O2", "-std=c++17", "-I"]).arg(&generated).arg("-I").arg(self.source(""));
        cc.arg(self.source("fast/peer.cpp"));
        cc.args(["messages.cxx", "messagesPubSubTypes.cxx"].map(|file| generated.join(file)));
        run(cc.args(["-lfastrtps", "-lfastcdr", "-o"]).arg(self.folder.join("fast-peer")), COMPILER)
    }

    fn python(&self) -> Result<(), Failure> {
        venv::apart(self.checkout, &self.folder.join("venv"), &["cyclonedds"]).map(drop)
    }
}
