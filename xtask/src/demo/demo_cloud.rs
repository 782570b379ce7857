//! The cloud of the demo, in the user's network.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};

use gleaner_base::{Exit, Failure};

use super::demo_vehicle::end;
use crate::checkout::Checkout;
use crate::steps;

/// Folder of the cloud, relative to the checkout.
const DATA: &str = "out/demo/cloud";

/// Folder of the token that `gleaner login` stores, relative to the checkout: the user's own
/// configuration stays as it is.
const CONFIG: &str = "out/demo/config";

/// The ports that users expect, for people and for vehicles.
const PORTS: [u16; 2] = [8080, 8443];

/// A running cloud. Dropping it ends it.
pub(super) struct DemoCloud {
    program: Option<Child>,
    pub(super) ports: [u16; 2],
    pub(super) url: String,
}

impl DemoCloud {
    /// Starts the cloud without any user or vehicle, and logs in.
    pub(super) fn start(checkout: &Checkout) -> Result<Self, Failure> {
        let failed = |error| Failure::caused_by(Exit::Internal, "cannot start a cloud", &error);
        steps::remove_folder(&checkout.path(DATA))?;
        steps::remove_folder(&checkout.path(CONFIG))?;
        steps::make_folder(&checkout.path("out/demo"))?;
        let log = File::create(checkout.path("out/demo/cloud.log")).map_err(failed)?;
        let mut serve = checkout.command(checkout.program("gleaner-cloud"));
        serve.args(["serve", "--data", DATA]);
        for (option, port) in ["--http", "--vehicles"].into_iter().zip(PORTS) {
            let free = TcpListener::bind(("127.0.0.1", port)).map_or(0, |_| port);
            serve.arg(option).arg(format!("127.0.0.1:{free}"));
        }
        // Ctrl-C in a terminal reaches the demo only, which then ends all in order.
        serve.process_group(0);
        serve.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(log);
        let mut program = serve.spawn().map_err(failed)?;
        let lines = program.stdout.take().map(BufReader::new).into_iter().flat_map(BufRead::lines);
        let mut cloud = Self { program: Some(program), ports: [0; 2], url: String::new() };
        let mut code = String::new();
        for line in lines.map_while(Result::ok) {
            match line.split_once(':').map(|(name, value)| (name, value.trim())) {
                Some(("people", url)) => cloud.url = url.to_owned(),
                Some(("vehicles", address)) => cloud.ports[1] = port(address),
                Some(("first", login)) => {
                    code = login.rsplit(' ').next().unwrap_or_default().to_owned();
                }
                // The last line.
                _ => break,
            }
        }
        cloud.ports[0] = port(&cloud.url);
        if code.is_empty() || cloud.ports.contains(&0) {
            return Err(Failure::new(Exit::Internal, "gleaner-cloud did not print its addresses")
                .with_help("`out/demo/cloud.log` is its log"));
        }
        let mut login = checkout.command(checkout.program("gleaner"));
        login.args(["login", &cloud.url, "--code", &code]);
        steps::run(account(checkout, &mut login), "`out/demo/cloud.log` is the log of the cloud")?;
        Ok(cloud)
    }

    pub(super) fn stop(mut self) -> Result<(), Failure> {
        self.program.take().map_or(Ok(()), |program| end(program, "gleaner-cloud"))
    }
}

impl Drop for DemoCloud {
    fn drop(&mut self) {
        if let Some(program) = self.program.take() {
            let _ = end(program, "gleaner-cloud");
        }
    }
}

/// Lets a command use the demo's token.
pub(super) fn account<'c>(checkout: &Checkout, gleaner: &'c mut Command) -> &'c mut Command {
    gleaner.env("XDG_CONFIG_HOME", checkout.path(CONFIG));
    gleaner.env_remove("GLEANER_CLOUD").env_remove("GLEANER_CLOUD_TOKEN")
}

/// Returns the port at the end of an address; 0 without one.
fn port(address: &str) -> u16 {
    address.rsplit(':').next().and_then(|port| port.parse().ok()).unwrap_or(0)
}
