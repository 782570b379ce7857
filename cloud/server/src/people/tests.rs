use axum::body::Body;
use gleaner_fleet::people::NewUser;
use hyper::service::Service;
use hyper_util::service::TowerToHyperService;
use tempfile::TempDir;
use tokio::sync::Semaphore;

use super::*;
use crate::attempts::{VehicleLimits, WrongSecrets};
use crate::authority::Authorities;
use crate::clips::ClipFiles;
use crate::folder::DataFolder;
use crate::hub::Hub;
use crate::objects::Objects;
use crate::place::FilePlace;
use crate::store::{ClipBounds, CloudStore, Retention};

pub(crate) const ROLES: [Role; 4] = [Role::Viewer, Role::Operator, Role::Deployer, Role::Admin];

pub(crate) async fn cloud(folder: &TempDir) -> Arc<Cloud> {
    let data = DataFolder::create(&folder.path().join("data")).unwrap();
    let clips = FilePlace::open(data.clips(), None, "").unwrap();
    Arc::new(Cloud {
        store: CloudStore::of_test(folder).await,
        objects: Objects::new(FilePlace::open(data.objects(), None, "").unwrap()),
        clips: Arc::new(ClipFiles::new(clips, ClipBounds::DEFAULT)),
        hub: Hub::default(),
        authorities: Authorities::open(&data).unwrap(),
        wrong_secrets: WrongSecrets::default(),
        limits: VehicleLimits::default(),
        readers: Arc::default(),
        stored_frames: Semaphore::new(4),
        retention: Retention::DEFAULT,
        address: "127.0.0.1:8443".to_owned(),
    })
}

/// Sends a request with a token; returns the status of the answer.
async fn status_of(
    cloud: &Arc<Cloud>,
    method: Method,
    path: &str,
    token: Option<&str>,
) -> StatusCode {
    let slots = Arc::new(Semaphore::new(1));
    let peer = PeerConnection::of_test([127, 0, 0, 1].into(), slots.try_acquire_owned().unwrap());
    let mut request = Request::builder().method(method).uri(path).extension(Arc::new(peer));
    if let Some(token) = token {
        request = request.header(header::AUTHORIZATION, format!("Bearer {token}"));
    }
    let router = TowerToHyperService::new(router(cloud));
    let reply = router.call(request.body(Body::from("{}")).unwrap()).await;
    reply.unwrap().status()
}

#[tokio::test]
async fn each_request_is_open_to_its_role_and_the_higher_ones_only() {
    let folder = TempDir::new().unwrap();
    let cloud = cloud(&folder).await;
    let mut tokens = Vec::new();
    for role in ROLES {
        let new = NewUser { name: role.to_string(), role };
        let code = cloud.store.invite("console", new).await.unwrap().code;
        let session = cloud.store.login(&code).await.unwrap().unwrap();
        tokens.push((role, session.token));
    }
    assert!(endpoints().len() > 15);
    for Endpoint { method, path, role, .. } in endpoints() {
        // Things that do not exist: a request that is let through changes nothing.
        let path = path.replace("{name}", "no-such").replace("{id}", "no-such");
        let path = path.replace("{change}", "start").replace("{sha256}", &"0".repeat(64));
        let status = status_of(&cloud, method.clone(), &path, None).await;
        let expected =
            if role.is_none() { StatusCode::BAD_REQUEST } else { StatusCode::UNAUTHORIZED };
        assert_eq!(status, expected, "{method} {path} without a token");
        for (has, token) in &tokens {
            let status = status_of(&cloud, method.clone(), &path, Some(token)).await;
            let is_let = role.is_none_or(|role| *has >= role);
            assert_eq!(
                status != StatusCode::FORBIDDEN,
                is_let,
                "{method} {path} as {has}: {status}"
            );
            assert_ne!(status, StatusCode::UNAUTHORIZED, "{method} {path} as {has}");
            assert!(!status.is_server_error(), "{method} {path} as {has}: {status}");
        }
    }
}

#[tokio::test]
async fn wrong_tokens_are_limited_and_the_user_is_removed_with_the_token() {
    let folder = TempDir::new().unwrap();
    let cloud = cloud(&folder).await;
    let new = NewUser { name: "ann".to_owned(), role: Role::Viewer };
    let code = cloud.store.invite("console", new).await.unwrap().code;
    let token = cloud.store.login(&code).await.unwrap().unwrap().token;
    let me = async |token| status_of(&cloud, Method::GET, "/v1/me", Some(token)).await;
    assert_eq!(me(&token).await, StatusCode::OK);
    cloud.store.remove_user("console", "ann").await.unwrap();
    for _ in 0..10 {
        assert_eq!(me(&token).await, StatusCode::UNAUTHORIZED);
    }
    assert_eq!(me(&token).await, StatusCode::TOO_MANY_REQUESTS);
    // Others at the address are not refused.
    let new = NewUser { name: "bea".to_owned(), role: Role::Viewer };
    let code = cloud.store.invite("console", new).await.unwrap().code;
    let other = cloud.store.login(&code).await.unwrap().unwrap().token;
    assert_eq!(me(&other).await, StatusCode::OK);
}
