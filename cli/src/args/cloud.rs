//! Arguments of the commands for the cloud: `login`, `users`, `vehicles`, `fleet` and others.

use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand};
use gleaner_base::parse_duration;
use gleaner_fleet::people::Role;
use gleaner_trust::VehicleName;

use super::{ClipsArgs, FleetArgs, VehicleArgs};

/// Commands of `gleaner` for the cloud.
#[derive(Subcommand, Debug)]
pub enum CloudCommand {
    /// Run a cloud, invite its first user, or save its state; see `gleaner cloud --help`
    #[command(disable_help_flag = true)]
    Cloud {
        /// Arguments of gleaner-cloud
        #[arg(value_name = "ARGUMENTS", trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<OsString>,
    },
    /// Log in to a cloud with the code of an invitation
    Login(LoginArgs),
    /// End the token, and forget the cloud
    Logout(ListArgs),
    /// Show the user of the token, and the cloud
    Whoami(ListArgs),
    /// List, invite or remove the users of the cloud
    Users(UsersArgs),
    /// List, make or remove tokens for programs that use the cloud
    Tokens(TokensArgs),
    /// List, enrol or revoke the vehicles of the cloud
    Vehicles(VehiclesArgs),
    /// List the deployments of the cloud, or change their waves
    Fleet(FleetArgs),
    /// List the clips of the vehicles of the cloud, fetch or export them
    Clips(ClipsArgs),
    /// Search the records of the vehicles of the cloud: log lines, triggers and events
    Search(SearchArgs),
    /// List who changed what in the cloud, the newest first
    Audit(AuditArgs),
    /// Connect this vehicle to a cloud
    Enrol(EnrolArgs),
    /// Disconnect this vehicle from its cloud; what runs goes on
    Unenrol(UnenrolArgs),
}

/// Arguments of the commands without others.
#[derive(Args, Debug)]
pub struct ListArgs {
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner login`.
#[derive(Args, Debug)]
pub struct LoginArgs {
    /// Address of the cloud, as in http://127.0.0.1:8080
    #[arg(value_name = "URL")]
    pub url: String,
    /// The code of the invitation, which works once [default: a line of standard input, as other
    /// users of this machine see arguments]
    #[arg(long, value_name = "CODE")]
    pub code: Option<String>,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner users`.
#[derive(Args, Debug)]
pub struct UsersArgs {
    /// The change; without one, the users are listed
    #[command(subcommand)]
    pub command: Option<UsersCommand>,
    /// Print the result as JSON
    #[arg(long, global = true)]
    pub json: bool,
}

/// Commands of `gleaner users`.
#[derive(Subcommand, Debug)]
pub enum UsersCommand {
    /// Add a user, or invite one again, and show the code for `gleaner login`
    Invite(UserArgs),
    /// Remove a user, whose tokens end at once
    Remove {
        /// Name of the user
        #[arg(value_name = "NAME", value_parser = name)]
        name: String,
    },
}

/// Arguments of `gleaner users invite`.
#[derive(Args, Debug)]
pub struct UserArgs {
    /// Name of the user
    #[arg(value_name = "NAME", value_parser = name)]
    pub name: String,
    /// The rights: viewer, operator, deployer or admin; each has those of the ones before
    #[arg(long, value_name = "ROLE")]
    pub role: Role,
}

/// Arguments of `gleaner tokens`.
#[derive(Args, Debug)]
pub struct TokensArgs {
    /// The change; without one, your tokens are listed, and for an admin all
    #[command(subcommand)]
    pub command: Option<TokensCommand>,
    /// Print the result as JSON
    #[arg(long, global = true)]
    pub json: bool,
}

/// Commands of `gleaner tokens`.
#[derive(Subcommand, Debug)]
pub enum TokensCommand {
    /// Make a token, and show it once; programs have it as GLEANER_CLOUD_TOKEN
    New(NewTokenArgs),
    /// Remove a token, which ends at once
    Remove(RemoveTokenArgs),
}

/// Arguments of `gleaner tokens new`.
#[derive(Args, Debug)]
pub struct NewTokenArgs {
    /// Name of the token, one of yours
    #[arg(value_name = "NAME", value_parser = name)]
    pub name: String,
    /// The rights: your role, or a lesser one
    #[arg(long, value_name = "ROLE")]
    pub role: Role,
    /// Days until the token ends, at most 366
    #[arg(long, value_name = "DAYS", default_value_t = 90)]
    pub days: u32,
}

/// Arguments of `gleaner tokens remove`.
#[derive(Args, Debug)]
pub struct RemoveTokenArgs {
    /// Name of the token
    #[arg(value_name = "NAME", value_parser = name)]
    pub name: String,
    /// User of the token, if it is not yours
    #[arg(long, value_name = "USER", value_parser = name)]
    pub user: Option<String>,
}

/// Arguments of `gleaner vehicles`.
#[derive(Args, Debug)]
pub struct VehiclesArgs {
    /// The change; without one, the vehicles are listed
    #[command(subcommand)]
    pub command: Option<VehiclesCommand>,
    /// Print the result as JSON
    #[arg(long, global = true)]
    pub json: bool,
}

/// Commands of `gleaner vehicles`.
#[derive(Subcommand, Debug)]
pub enum VehiclesCommand {
    /// Add a vehicle, and write the file for `gleaner enrol` on it
    Enrol(NewVehicleArgs),
    /// Print the keys that verify clips, a line for each vehicle, for `gleaner verify --trust`
    Keys,
    /// Let a vehicle follow this cloud, which was restored from a backup: it ends what this state
    /// does not have
    Agree {
        /// Name of the vehicle
        #[arg(value_name = "NAME")]
        name: VehicleName,
    },
    /// Cut a vehicle off: it cannot connect again until it is enrolled again
    Revoke {
        /// Name of the vehicle
        #[arg(value_name = "NAME")]
        name: VehicleName,
    },
}

/// Arguments of `gleaner vehicles enrol`.
#[derive(Args, Debug)]
pub struct NewVehicleArgs {
    /// Name of the vehicle
    #[arg(value_name = "NAME")]
    pub name: VehicleName,
    /// The new file, which has a secret
    #[arg(long, value_name = "FILE")]
    pub to: PathBuf,
}

/// Arguments of `gleaner search`.
#[derive(Args, Debug)]
pub struct SearchArgs {
    /// Text in the records, without regard to the case of A to Z [default: any]
    #[arg(value_name = "TEXT", default_value = "", hide_default_value = true)]
    pub text: String,
    /// Only records of this vehicle
    #[arg(long, value_name = "NAME")]
    pub vehicle: Option<VehicleName>,
    /// Only vehicles with this label, as in site=berlin
    #[arg(long, value_name = "NAME=VALUE")]
    pub label: Option<String>,
    /// Only records of the lambda of this deployment
    #[arg(long, value_name = "ID")]
    pub lambda: Option<String>,
    /// Only records of this kind, as in log, trigger, fault or event
    #[arg(long, value_name = "KIND")]
    pub kind: Option<String>,
    /// Only log lines of this level or a higher one, and faults: trace, debug, info, warn or error
    #[arg(long, value_name = "LEVEL", value_parser = ["trace", "debug", "info", "warn", "error"])]
    pub level: Option<String>,
    /// Only records within this time before now, as in 2h
    #[arg(long, value_name = "DURATION", value_parser = parse_duration)]
    pub since: Option<Duration>,
    /// Maximum number of records to show
    #[arg(long, short = 'n', value_name = "N", default_value_t = 100)]
    pub last: usize,
    /// Print each record as a line of JSON
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner audit`.
#[derive(Args, Debug)]
pub struct AuditArgs {
    /// Number of the newest entries to show
    #[arg(long, short = 'n', value_name = "N", default_value_t = 100)]
    pub last: usize,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner enrol`.
#[derive(Args, Debug)]
pub struct EnrolArgs {
    /// The file of `gleaner vehicles enrol`
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Longest wait for the connection
    #[arg(long, value_name = "DURATION", default_value = "1min", value_parser = parse_duration)]
    pub timeout: Duration,
    /// The orchestrator
    #[command(flatten)]
    pub vehicle: VehicleArgs,
}

/// Arguments of `gleaner unenrol`.
#[derive(Args, Debug)]
pub struct UnenrolArgs {
    /// Also remove the key of this vehicle, before its disk is copied to others: each copy makes
    /// its own at its first start
    #[arg(long)]
    pub new_identity: bool,
    /// The orchestrator
    #[command(flatten)]
    pub vehicle: VehicleArgs,
}

/// Parses the name of a user, which becomes a part of a path.
fn name(text: &str) -> Result<String, String> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || "._-@+".contains(c);
    match (1..=64).contains(&text.len()) && text.chars().all(allowed) {
        true => Ok(text.to_owned()),
        false => Err("write 1 to 64 letters, digits and `._-@+`, as in ada".to_owned()),
    }
}
